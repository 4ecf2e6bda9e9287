"""The page of a batch: a row and a thumbnail for every recording."""

import base64
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from napari_fiberburst.io.results import versions, write_whole
from napari_fiberburst.results.batch import Row

_VERDICTS = ("good", "doubtful", "bad", "not judged", "failed")


def write_batch(path: Path, rows: Sequence[Row], title: str) -> None:
    """Write one HTML file that stands alone but for its links to what was made, which lies beside it.

    Parameters
    ----------
    path : Path
        The file, in the folder of the batch.
    rows : sequence of Row
        In the order in which they are shown.
    title : str
        Of the page.
    """
    style = files("napari_fiberburst.report").joinpath("style.css").read_text(encoding="utf-8")
    counts = [(sum(row.verdict == verdict for row in rows), verdict) for verdict in _VERDICTS]
    told = ", ".join(f"{count} {verdict}" for count, verdict in counts if count)
    version = versions()["versions"].get("napari-fiberburst", "")
    made = f"napari-fiberburst {version}; {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    head = "<thead><tr><th></th><th>recording</th><th>verdict</th><th>notes</th><th>written</th></tr></thead>"
    body = "".join(_row(row, path.parent) for row in rows)
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{escape(title)}</title>\n<link rel="icon" href="data:,">\n<style>\n{style}</style>\n</head>\n<body>\n'
        f'<header>\n<h1>{escape(title)}</h1>\n<p class="origin">{len(rows)} recordings: {told}<br>{escape(made)}</p>\n'
        f'</header>\n<table class="batch">{head}<tbody>\n{body}</tbody></table>\n</body>\n</html>\n'
    )
    with write_whole(path) as stream:
        stream.write(page.encode())


def _row(row: Row, folder: Path) -> str:
    picture = ""
    if row.thumbnail and (folder / row.thumbnail).exists():
        encoded = base64.b64encode((folder / row.thumbnail).read_bytes()).decode()
        picture = f'<img alt="{escape(row.name)}" src="data:image/png;base64,{encoded}">'
    kind = row.verdict if row.verdict in _VERDICTS[:3] else "bad" if row.verdict == "failed" else "unjudged"
    notes = "".join(f"<li>{escape(note)}</li>" for note in row.notes)
    facts = "<br>".join(escape(fact) for fact in (*row.facts, f"{row.seconds:.0f} s"))
    links = "<br>".join(f'<a href="{quote(output)}">{escape(Path(output).name)}</a>' for output in row.outputs)
    return (
        f'<tr><td>{picture}</td><td>{escape(row.name)}<br><span class="doc">{facts}</span></td>'
        f'<td class="{kind}">{escape(row.verdict)}</td><td><ul>{notes}</ul></td><td>{links}</td></tr>\n'
    )

"""The page of a report: its parts, in the order in which they are read."""

from collections.abc import Iterable
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.picture import as_picture, limits_of
from napari_fiberburst.io.results import check_place, versions, write_whole
from napari_fiberburst.quality.resolution import THRESHOLD
from napari_fiberburst.report.facts import check_made_from, extent_of, field_of, in_words, number_used, scale_of
from napari_fiberburst.report.figures import Chart, path_of, picture
from napari_fiberburst.results.reconstruction import Reconstruction

_ENDINGS = (".html", ".htm")
_VERDICTS = {
    "good": "Good: nothing in the burst speaks against the image.",
    "doubtful": "Doubtful: the image is worse than such a burst should give.",
    "bad": "Bad: the image does not show the object.",
    None: "Not judged: this method does not tell how far its image can be trusted.",
}
_ENDED = {
    "finished": "",
    "stopped": "The run was stopped before its end.",
    "time budget": "The run ended with its time budget.",
    "diverged": "The run diverged; this is its last good state.",
}


def check_report(path: str | Path) -> Path:
    """Refuse a path that a report should not be written to; before a long run rather than after it.

    Raises
    ------
    OutputError
        The ending is not .html, or the folder does not exist or cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in _ENDINGS:
        raise OutputError(f"a report is written to a file ending in .html; got {target}")
    check_place(target)
    return target


def write_report(
    result: Reconstruction, burst: Burst, path: str | Path, *, name: str = "burst", call: str | None = None
) -> Path:
    """Write all that is known of a reconstruction into one HTML file that stands alone.

    Before and after, the verdict and why, what the image rests on, every setting, the versions, and the call that
    repeats it. Nothing is loaded from elsewhere; it can be printed, and follows the reader's light or dark theme.

    Parameters
    ----------
    result : Reconstruction
        What is reported.
    burst : Burst
        That it was made from.
    path : str or Path
        A file ending in ``.html``.
    name : str
        Of the burst, such as the name of its file.
    call : str, optional
        What repeats the run, such as a command line. By default it is a call in Python with all settings as they were
        asked for, which knows of no bundle that was given.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    OutputError
        The ending is not .html, or the folder does not exist or cannot be written; or the result was made from
        another burst.
    """
    target = check_report(path)
    check_made_from(result, burst)
    style = files("napari_fiberburst.report").joinpath("style.css").read_text(encoding="utf-8")
    title = escape(f"{name}: a reconstruction")
    parts = [_head(result, name), _verdict(result), _before_and_after(result, burst), _facts(result), _charts(result)]
    parts += [_maps(result), _settings(result), _origin(result, name, call)]
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{title}</title>\n<link rel="icon" href="data:,">\n<style>\n{style}</style>\n</head>\n<body>\n'
        f"{''.join(parts)}</body>\n</html>\n"
    )
    with write_whole(target) as stream:
        stream.write(page.encode())
    return target


def _head(result: Reconstruction, name: str) -> str:
    frames, height, width, channels = result.acquisition.shape
    colours = {1: "grey", 3: "three channels"}.get(channels, f"{channels} channels")
    if result.acquisition.channel_names:
        colours += f" ({', '.join(result.acquisition.channel_names)})"
    told = f"{frames} frames of {height} x {width} pixels, {colours}, {result.acquisition.dtype}"
    date = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    made = f"napari-fiberburst {_version('napari-fiberburst')}, {result.seconds:.1f} s on {result.device}; {date}"
    return f'<header>\n<h1>{escape(name)}</h1>\n<p class="origin">{escape(told)}<br>{escape(made)}</p>\n</header>\n'


def _verdict(result: Reconstruction) -> str:
    notes = "".join(f"<li>{escape(note)}</li>" for note in result.notes)
    why = f"<ul>{notes}</ul>" if notes else ""
    ended = f"<p>{escape(_ENDED[result.ending])}</p>" if _ENDED[result.ending] else ""
    kind = result.quality or "unjudged"
    return f'<div class="verdict {kind}"><strong>{_VERDICTS[result.quality]}</strong>{ended}{why}</div>\n'


def _before_and_after(result: Reconstruction, burst: Burst) -> str:
    _, height, width, _ = result.acquisition.shape
    frame = burst.frames[result.reference]
    before = picture(as_picture(frame), "a captured frame", width=width, height=height, **scale_of(result))
    across = extent_of(result)
    after = picture(
        as_picture(result.image), "the reconstruction", width=across[0], height=across[1], **scale_of(result)
    )
    return (
        "<h2>Before and after</h2>\n<div class='row'>"
        f"{_figure(before, 'Captured', f'frame {result.reference} of {len(burst.frames)}')}"
        f"{_figure(after, 'Reconstructed', f'from {number_used(result)} frames')}</div>\n"
    )


def _facts(result: Reconstruction) -> str:
    rows: list[tuple[str, str]] = [
        ("frames used", f"{number_used(result)} of {len(result.homographies)}{_left_out(result)}")
    ]
    if result.resolution is not None:
        rows.append(("resolution, by two halves of the burst", in_words(result, result.resolution)))
    if result.held_out_rmse is not None:
        rows.append(("samples left out are missed by", f"{result.held_out_rmse:.3g} of {_span(result):g}"))
    if result.misfit is not None:
        rows.append(("misfit", f"{result.misfit:.2f} times the camera's noise"))
    if result.coverage is not None:
        empty = _empty(result)
        filled = (result.coverage == 0) & ~empty
        rows.append(
            ("filled in from the surroundings", f"{filled.mean():.1%} of the image; left empty {empty.mean():.1%}")
        )
    if result.exposures is not None and np.isfinite(result.exposures).any():
        known = result.exposures[np.isfinite(result.exposures)]
        rows.append(("brightness of the frames", f"{known.min():.3f} to {known.max():.3f} of their mean"))
    if result.outliers is not None:
        rows.append(("samples that show something else", f"{result.outliers.sum()} of {result.outliers.size}"))
    if result.bundle is not None and result.bundle.is_resolved:
        bundle = result.bundle
        cores = f"{len(bundle.centres)} cores, {in_words(result, bundle.pitch)} apart; {len(bundle.dead)} dead"
        rows.append(("bundle", cores))
    rows.append(("motion", result.settings.method.motion.name))
    return f"<h2>What the image rests on</h2>\n{_table(rows)}\n"


def _charts(result: Reconstruction) -> str:
    charts = [_agreement(result), _residuals(result), _way(result), _errors(result)]
    return f"<h2>Curves</h2>\n<div class='row'>{''.join(charts)}</div>\n"


def _agreement(result: Reconstruction) -> str:
    told = "Resolution"
    if result.agreement is None:
        return _missing(told, "two halves of the burst were not compared")
    frequency, correlation = result.agreement.frequency, result.agreement.correlation
    limit = float(frequency[-1])
    chart = Chart("agreement of halves", "cycles per pixel", "correlation", (0, limit), (min(0, correlation.min()), 1))
    chart.mark_y(THRESHOLD, "1/7")
    if result.resolution is not None and 1 / result.resolution <= limit:
        chart.mark_x(1 / result.resolution, in_words(result, result.resolution))
    chart.line(frequency, correlation)
    return _figure(chart.svg(), told, "Fourier ring correlation of two halves of the burst; finer than 1/7 is noise")


def _residuals(result: Reconstruction) -> str:
    told = "Residual of each frame"
    if result.residuals is None:
        return _missing(told, "what the model misses is not known for this method")
    frames = _root_mean_square(result.residuals, axis=1)
    most = float(np.nanmax(frames)) if np.isfinite(frames).any() else 1.0
    chart = Chart(told, "frame", "intensity", (-0.7, len(frames) - 0.3), (0, max(most * 1.1, 1e-9)), whole_x=True)
    chart.bars(frames, [f"frame {frame}: {value:.3g}" for frame, value in enumerate(frames)])
    return _figure(chart.svg(), told, "what the image, seen through the bundle, leaves; none where one was left out")


def _way(result: Reconstruction) -> str:
    told = "Way of the frames"
    _, height, width, _ = result.acquisition.shape
    usable = [frame for frame, matrix in enumerate(result.homographies) if np.isfinite(matrix).all()]
    middle = np.array([[(width - 1) / 2, (height - 1) / 2]])
    pixel, unit = scale_of(result).values()
    points = [(transform_points(result.homographies[frame], middle) - middle)[0] * pixel for frame in usable]
    caption = f"where the middle of each frame lies in frame {result.reference}; the ring is the first frame used"
    return _figure(path_of(np.array(points), usable, unit), told, caption)


def _errors(result: Reconstruction) -> str:
    told = "Error while it was fitted"
    losses = result.losses.astype(float)
    known = losses[np.isfinite(losses) & (losses > 0)]
    if known.size == 0:
        return _missing(told, "nothing was fitted")
    low, high = float(known.min()), float(known.max())
    chart = Chart(
        told, "step", "mean squared error", (0, len(losses)), (low / 1.3, high * 1.3), log_y=True, whole_x=True
    )
    chart.line(np.arange(1, len(losses) + 1), losses)
    return _figure(chart.svg(), told, "with intensities from -1 to 1; it begins once there is something to compare")


def _maps(result: Reconstruction) -> str:
    shown = [_map(result, "Coverage", result.coverage, "samples to a pixel", extent_of(result))]
    uncertainty = None if result.uncertainty is None else np.where(_empty(result), np.nan, result.uncertainty)
    shown.append(_map(result, "Uncertainty", uncertainty, "intensity", extent_of(result)))
    shown.append(_map(result, "Residual of each core", _residual_map(result), "intensity", field_of(result)))
    found = "".join(entry for entry in shown if entry)
    return f"<h2>Maps</h2>\n<div class='row small'>{found}</div>\n" if found else ""


def _map(
    result: Reconstruction, title: str, values: NDArray[np.floating] | None, what: str, extent: tuple[float, float]
) -> str:
    if values is None:
        return ""
    low, high = limits_of(values)
    drawn = picture(as_picture(values, (low, high)), title, width=extent[0], height=extent[1], **scale_of(result))
    return _figure(drawn, title, f"{what}, from {low:.3g} (black) to {high:.3g} (white)")


def _residual_map(result: Reconstruction) -> NDArray[np.float64] | None:
    """Return the root mean square residual of each core over the frames, where the core is, (H, W)."""
    if result.residuals is None or result.bundle is None:
        return None
    of_cores = _root_mean_square(result.residuals, axis=0)
    shown: NDArray[np.float64] = np.append(of_cores, np.nan)[result.bundle.labels]
    return shown


def _root_mean_square(residuals: NDArray[np.float32], axis: int) -> NDArray[np.float64]:
    """Return the root mean square of what is known along an axis; NaN where nothing is."""
    known = np.isfinite(residuals)
    count = known.sum(axis=axis)
    total = np.sum(np.where(known, residuals, 0) ** 2.0, axis=axis)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _settings(result: Reconstruction) -> str:
    asked, used, known = result.requested.flat(), result.settings.flat(), result.settings.parameters
    rows = []
    for name, value in used.items():
        doc = known[name].doc if name in known else ""
        given = asked.get(name)
        wish = "" if given == value else "auto" if given is None else _plain(given)
        kind = ' class="changed"' if wish else ""
        rows.append(f"<tr{kind}>{_cells(name, _plain(value), wish)}<td class='doc'>{escape(doc)}</td></tr>")
    head = "<thead><tr><th>setting</th><th>value</th><th>asked for</th><th>what it does</th></tr></thead>"
    return f"<h2>Settings</h2>\n<table class='settings'>{head}<tbody>{''.join(rows)}</tbody></table>\n"


def _origin(result: Reconstruction, name: str, call: str | None) -> str:
    found = result.made_with.get("versions", {})
    rows = [("seed", _plain(result.settings.seed)), ("device", result.device)]
    rows += [("versions", ", ".join(f"{package} {number}" for package, number in found.items()))]
    again = _call_of(result, name) if call is None else call
    return (
        f"<h2>Where it comes from</h2>\n{_table(rows)}\n<p>This repeats it:</p>\n<pre>{escape(again.strip())}</pre>\n"
    )


def _call_of(result: Reconstruction, name: str) -> str:
    """Return a call in Python that makes the same image of the same burst: with what was asked for, bit for bit."""
    return (
        "from napari_fiberburst import Settings, reconstruct\n\n"
        f"settings = Settings.from_dict({result.requested.to_dict()!r})\n"
        f"result = reconstruct({name!r}, preset=settings)\n"
    )


def _figure(drawn: str, title: str, caption: str) -> str:
    told = f"<b>{escape(title)}.</b> {escape(caption[0].upper() + caption[1:])}."
    return f"<figure>{drawn}<figcaption>{told}</figcaption></figure>\n"


def _missing(title: str, why: str) -> str:
    return _figure("", title, f"not shown, because {why}")


def _table(rows: Iterable[tuple[str, str]]) -> str:
    return f"<table><tbody>{''.join(f'<tr>{_cells(*row)}</tr>' for row in rows)}</tbody></table>"


def _cells(*texts: str) -> str:
    return "".join(f"<td>{escape(text)}</td>" for text in texts)


def _plain(value: object) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _version(package: str) -> str:
    return str(versions()["versions"].get(package, ""))


def _left_out(result: Reconstruction) -> str:
    if result.frames_used is None:
        return ""
    missing = sorted(set(range(len(result.homographies))) - set(result.frames_used))
    return f"; left out: {', '.join(map(str, missing))}" if missing else ""


def _empty(result: Reconstruction) -> NDArray[np.bool_]:
    """Return where the image has nothing, (H, W)."""
    empty: NDArray[np.bool_] = np.any(np.isnan(result.image.reshape(*result.canvas.shape, -1)), axis=2)
    return empty


def _span(result: Reconstruction) -> float:
    return result.acquisition.white_level - result.acquisition.black_level

"""Open pages in a browser without a window, and tell what a reader would stumble over."""

import functools
import json
import queue
import re
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from tests.preflight import BROWSERS, find_browser

_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--enable-logging=stderr",
    "--remote-debugging-port=0",  # stays open until it is ended
    # Nothing is asked of the network.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)
# Opens each page in a frame of one window, and reports what is seen there.
_PROBE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><script>
const settle = milliseconds => new Promise(done => setTimeout(done, milliseconds));
const isCut = block => block.scrollWidth > block.clientWidth + 1 && block.clientWidth > 0;
async function look(page, width) {
  const frame = document.createElement("iframe");
  frame.style.cssText = `border: 0; width: ${width}px; height: 1200px`;
  const loaded = new Promise(done => frame.onload = done);
  frame.src = "/" + page;
  document.body.replaceChildren(frame);
  await loaded;
  const inside = frame.contentDocument;
  const images = [...inside.images];
  for (const image of images) image.loading = "eager";
  await Promise.all(images.map(image => image.decode().catch(() => null)));
  await inside.fonts.ready;
  await settle(50);
  const words = inside.body.cloneNode(true);
  const listings = [...words.querySelectorAll("pre")].map(block => block.textContent);
  for (const part of words.querySelectorAll("pre, code, script, style, .katex")) part.remove();
  const asked = frame.contentWindow.performance.getEntriesByType("resource");
  return {
    title: inside.title,
    elsewhere: asked.map(entry => entry.name).filter(name => !/^(blob|data):/.test(name) && !name.startsWith(origin)),
    refused: asked.filter(entry => entry.responseStatus >= 400).map(entry => entry.name),
    text: words.textContent,
    listings,
    badEquations: [...inside.querySelectorAll(".katex-error, .arithmatex:not(:has(.katex))")].map(e => e.textContent),
    missing: images.filter(image => !image.naturalWidth).map(image => image.getAttribute("src")),
    cut: [...inside.querySelectorAll("pre, pre > code, .katex-display, .md-typeset__scrollwrap, figure")]
      .filter(isCut).map(block => block.textContent.trim().slice(0, 60)),
    isWide: inside.documentElement.scrollWidth > width,
  };
}
(async () => {
  const {pages, width} = await (await fetch("/_pages")).json();
  const found = {};
  for (const page of pages) found[page] = await look(page, width);
  await fetch("/_found", {method: "POST", body: JSON.stringify(found)});
})().catch(error => fetch("/_found", {method: "POST", body: JSON.stringify({"": String(error)})}));
</script><body></body>"""
# Marks of Markdown and of its extensions that stand in the text where one of them was not understood.
_RAW = re.compile(r"""=== "|^!!!|^\?\?\?|--8<--|\$|\\[(\[]|^:::|\*\*|!\[|\]\(|\{[:.#]|^#+ |```""", re.MULTILINE)
_CONSOLE = re.compile(r"CONSOLE[:(]\d+\)?\] (.*)")


def faults_of(root: Path, pages: Sequence[str], width: int = 1280) -> list[str]:
    """Open pages in a browser; return what is wrong with them, a line each.

    Parameters
    ----------
    root : Path
        The folder that is served.
    pages : sequence of str
        Paths within it.
    width : int
        Of the window, in pixels.
    """
    found, console = look_at(root, pages, width)
    faults = [f"console: {line}" for line in console]
    for page, seen in found.items():
        for text in (seen["text"], *(f"\n{text}" for text in seen["listings"] if "--8<--" in text)):
            faults += [f"{page}: raw mark {_around(text, match)}" for match in _RAW.finditer(text)]
        faults += [f"{page}: equation {text!r} is not set" for text in seen["badEquations"]]
        faults += [f"{page}: asks for {address}" for address in seen["elsewhere"]]
        faults += [f"{page}: not there: {address}" for address in seen["refused"]]
        faults += [f"{page}: no picture at {address}" for address in seen["missing"]]
        faults += [f"{page}: cut off: {text!r}" for text in seen["cut"]]
        if seen["isWide"]:
            faults.append(f"{page}: wider than the window")
    return faults


def look_at(root: Path, pages: Sequence[str], width: int = 1280) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Return what is seen on each page, and what the browser's console says; parameters as of `faults_of`."""
    browser = find_browser()
    assert browser is not None, f"a browser is needed ({', '.join(BROWSERS)}); tests/preflight.py says how to get one"
    with (
        _served(root, {"pages": list(pages), "width": width}) as (address, answers),
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
    ):
        log = Path(profile, "log")
        command = [browser, *_FLAGS, f"--user-data-dir={profile}", f"--window-size={width},1200", f"{address}/_probe"]
        with log.open("wb") as stream:
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stream)
            try:
                found = answers.get(timeout=90)
            except queue.Empty:
                raise AssertionError(f"the browser gave no answer: {log.read_text(errors='replace')[-2000:]}") from None
            finally:
                process.terminate()
                process.wait(timeout=30)
        said = _CONSOLE.findall(log.read_text(encoding="utf-8", errors="replace"))
    assert "" not in found, found[""]
    return found, said


@contextmanager
def _served(root: Path, wanted: dict[str, Any]) -> Iterator[tuple[str, "queue.Queue[Any]"]]:
    """Serve a folder, the probe, and what the probe asks for; the queue gets the probe's answer."""
    answers: queue.Queue[Any] = queue.Queue()

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            own = {"/_probe": ("text/html", _PROBE), "/_pages": ("application/json", json.dumps(wanted))}
            if self.path not in own:
                super().do_GET()
                return
            kind, body = own[self.path]
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.end_headers()
            self.wfile.write(body.encode())

        def do_POST(self) -> None:
            answers.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, format: str, *arguments: Any) -> None:
            """Say nothing: what is missing is found in the page."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(root)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", answers
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _around(text: str, match: "re.Match[str]") -> str:
    return repr(" ".join(text[max(0, match.start() - 30) : match.end() + 30].split()))

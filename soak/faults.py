"""Faults while something is written or read: what was there stays, and one line says what has happened."""

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from napari_fiberburst import load, open_recording, reconstruct
from napari_fiberburst.io.results import sidecar_of
from napari_fiberburst.simulation import simulate
from soak.trials import Count, wrong_with

COMMAND = [sys.executable, "-m", "napari_fiberburst"]
# Seconds in which any of these commands ends on a busy machine.
_LIMIT = 120
_SAVING = """
import sys
from napari_fiberburst import load
result = load(sys.argv[1], "cpu")
print("begun", flush=True)
while True:
    result.save(sys.argv[2])
"""


def killed(count: Count, kills: int) -> None:
    """Kill what saves over a result, at random moments: the file is the one before or the one after."""
    random = np.random.default_rng(3)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _saved(folder / "source.npz")
        for number in range(kills):
            kept = folder / ("kept.npz" if number % 2 else "kept.ome.tif")
            load(folder / "source.npz", "cpu").save(kept)
            words = [sys.executable, "-c", _SAVING, str(folder / "source.npz"), str(kept)]
            with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
                assert process.stdout is not None
                process.stdout.readline()
                time.sleep(float(random.uniform(0, 0.3)))
                process.kill()
            count.faults += 1
            if kept.suffix == ".npz":
                count.check(partial(load, kept, "cpu"), wrong_with, f"kill {number}")
            else:
                count.check(partial(tifffile.imread, kept), _wrong_image, f"kill {number}")


def interrupted(count: Count, times: int) -> None:
    """Send Ctrl-C to the command at random moments: no traceback, a status, and an earlier output that is whole."""
    random = np.random.default_rng(4)
    with tempfile.TemporaryDirectory() as name:
        burst, output = _burst(Path(name)), Path(name, "out.ome.tif")
        words = [*COMMAND, "reconstruct", str(burst), "-o", str(output)]
        begun = time.perf_counter()
        subprocess.run(words, capture_output=True, check=True, timeout=_LIMIT)
        usual, whole = time.perf_counter() - begun, output.read_bytes()
        for _ in range(times):
            # Before its first line Python itself may print a traceback, and nothing of ours can prevent it.
            after = float(random.uniform(0.1, 1.05)) * usual
            with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
                time.sleep(after)
                process.send_signal(signal.SIGINT)
                _, told = process.communicate(timeout=_LIMIT)
            count.faults += 1
            count.tried += 1
            # As Python ends, after all is written, the signal ends it.
            if process.returncode not in (0, 130, -signal.SIGINT) or "Traceback" in told:
                count.lose(f"after {after:.2f} of {usual:.2f} s: status {process.returncode}: {told[-400:]}")
            if _wrong_image(tifffile.imread(output)) or (process.returncode == 130 and not output.read_bytes()):
                count.lose(f"after {after:.2f} s: the output is damaged")
            output.write_bytes(whole)


def surroundings(count: Count, rounds: int) -> None:
    """Run the command where the disk is full, the folder cannot be written, nobody reads, or the terminal is ASCII."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        burst, output = _burst(folder), folder / "out.ome.tif"
        reconstruct_it = [*COMMAND, "reconstruct", str(burst), "-o"]
        subprocess.run([*reconstruct_it, str(output)], capture_output=True, check=True, timeout=_LIMIT)
        before = output.read_bytes(), sidecar_of(output).read_bytes()
        for _ in range(rounds):
            _told(count, "a full disk", [*reconstruct_it, str(output)], 2, limited=True)
            if before != (output.read_bytes(), sidecar_of(output).read_bytes()):
                count.lose("a full disk: the earlier output has changed")
            if list(folder.glob("*.part")):
                count.lose("a full disk: half of a file is left")
            _told(count, "a folder that cannot be written", [*reconstruct_it, "/proc/out.ome.tif"], 2)
            _told(count, "a folder that is none", [*reconstruct_it, str(burst / "out.ome.tif")], 2)
            _told(
                count, "a burst that is gone", [*COMMAND, "reconstruct", str(folder / "gone.tif"), "-o", str(output)], 2
            )
            ascii_only = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
            _told(count, "an ASCII terminal", [*COMMAND, "info", str(burst)], 0, environment=ascii_only)
            _told(
                count,
                "a closed pipe",
                ["bash", "-c", f"{' '.join(COMMAND)} info {burst} | true; exit ${{PIPESTATUS[0]}}"],
                141,
                0,
            )
            _vanishing(count, folder)


def _vanishing(count: Count, folder: Path) -> None:
    """Cut a recording short while it is open, and remove it."""
    path = folder / "open.tif"
    for fault in (lambda: os.truncate(path, path.stat().st_size // 2), path.unlink):
        tifffile.imwrite(path, np.zeros((40, 64, 64), np.uint16) + np.arange(64, dtype=np.uint16))
        source = open_recording(path)
        source.recorded([0])
        fault()
        count.faults += 1
        count.check(
            partial(source.recorded, [39]),
            lambda frames: None if frames[:, :, 1].all() else "black",
            "a file that goes",
        )


def _told(
    count: Count,
    what: str,
    words: Sequence[str],
    *statuses: int,
    limited: bool = False,
    environment: dict[str, str] | None = None,
) -> None:
    """Run a command in some trouble; it has to end with one of these statuses, and without a traceback."""
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        timeout=_LIMIT,
        env={**os.environ, **(environment or {})},
        preexec_fn=_limit_files if limited else None,
    )
    count.tried += 1
    count.faults += 1
    lines = done.stderr.strip().splitlines()
    if done.returncode not in statuses or "Traceback" in done.stderr or (done.returncode == 2 and not lines):
        count.lose(f"{what}: status {done.returncode}, {done.stderr[-400:]}")


def _limit_files() -> None:
    """Let no file grow beyond 2 kB, which fails as a full disk does."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))


def _burst(folder: Path) -> Path:
    path = folder / "burst.tif"
    frames = simulate("cat", shape=(61, 67), frames=5, pitch=4.0, channels=1, seed=2).burst.frames[..., 0]
    tifffile.imwrite(path, np.rint(frames * 255).astype(np.uint8), photometric="minisblack")
    return path


def _saved(path: Path) -> None:
    burst = simulate("cat", shape=(141, 167), frames=4, pitch=4.0, channels=1, seed=2).burst
    reconstruct(burst, device="cpu").save(path)


def _wrong_image(image: NDArray[Any]) -> str | None:
    return None if np.isfinite(image).any() else "an image without a finite pixel"

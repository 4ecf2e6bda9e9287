"""Workers: how much faster two are than one, and whether kills at random moments lose anything.

Each run makes a mosaic of the same simulated recording, and all of them have to come to the same bits.
"""

import argparse
import contextlib
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from napari_fiberburst.io import open_recording
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.recordings.cluster import workers
from napari_fiberburst.recordings.mosaic import mosaic
from napari_fiberburst.simulation import simulate_recording

SHAPE, FRAMES, STEP = (193, 241), 640, 12.0
NAME, LIMIT = "m.ome.zarr", 0.6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("speed", "kills", "client"), nargs="?", help="default: speed and kills")
    parser.add_argument("paths", type=Path, nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--kills", type=int, nargs=2, default=(10, 5), metavar=("WORKERS", "CLIENTS"))
    options = parser.parse_args()
    if options.part == "client":
        make(options.paths[0], options.paths[1], 2)
        return
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.mkv"
        simulated = simulate_recording(path="raster", shape=SHAPE, frames=options.frames, step=STEP, seed=1)
        write_video(simulated.source, clip)
        if options.part in (None, "speed"):
            speed(clip, Path(folder))
        if options.part in (None, "kills"):
            kills(clip, Path(folder), *options.kills)


def make(clip: Path, output: Path, count: int) -> float:
    """Make a mosaic by workers in a folder, and return the seconds that it took once they were there."""
    output.mkdir(exist_ok=True)
    source = open_recording(clip)
    with workers(count, shape=source.shape) as client:
        assert client is not None
        client.wait_for_workers(count)
        begun = time.perf_counter()
        mosaic(source, output / NAME, client=client)
        return time.perf_counter() - begun


def speed(clip: Path, folder: Path) -> None:
    """Say how long one and two workers take."""
    took = {count: make(clip, folder / str(count), count) for count in (1, 2)}
    same = digest(folder / "1") == digest(folder / "2")
    print(f"1 worker {took[1]:.1f} s, 2 workers {took[2]:.1f} s: {took[2] / took[1]:.2f} of it; limit {LIMIT}")
    print(f"the same bits: {same}; load of the machine {os.getloadavg()[0]:.1f}")


def kills(clip: Path, folder: Path, of_workers: int, of_clients: int) -> None:
    """Kill workers and clients at random moments while a mosaic is made again and again; say what is left of it."""
    drawn, killed, runs = np.random.default_rng(5), [0, 0], 0
    begun = time.perf_counter()
    make(clip, folder / "whole", 1)
    usual = time.perf_counter() - begun
    expected = digest(folder / "whole")
    while killed[0] < of_workers or killed[1] < of_clients:
        runs += 1
        killed_here = broken(clip, folder, drawn, [of_workers - killed[0], of_clients - killed[1]], usual)
        killed = [one + other for one, other in zip(killed, killed_here, strict=True)]
        same = digest(folder / "killed") == expected
        print(
            f"run {runs}: {killed_here[0]} workers and {killed_here[1]} clients killed; the same bits: {same}",
            flush=True,
        )
        shutil.rmtree(folder / "killed")


def broken(clip: Path, folder: Path, drawn: np.random.Generator, left: list[int], usual: float) -> list[int]:
    """Make one mosaic, with kills at random moments; returns how many workers and clients were killed."""
    output, killed = folder / "killed", [0, 0]
    while not (output / NAME).exists() or (output / "m.work").exists():
        words = [sys.executable, "-m", "benchmarks.recordings_cluster", "client", str(clip), str(output)]
        with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
            while process.poll() is None:
                time.sleep(drawn.uniform(0.05, 0.4) * usual)
                victims = workers_of(process.pid)
                if killed[0] < left[0] and victims and (killed[1] >= left[1] or drawn.random() < 0.7):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        victims[int(drawn.integers(len(victims)))].send_signal(signal.SIGKILL)
                        killed[0] += 1
                elif killed[1] < left[1] and process.poll() is None:
                    process.kill()
                    killed[1] += 1
        if process.returncode not in (0, -signal.SIGKILL):
            print(f"a client has ended with status {process.returncode}")
    return killed


def workers_of(client: int) -> list[psutil.Process]:
    """Return the processes of a client that work."""
    with contextlib.suppress(psutil.NoSuchProcess):
        children = psutil.Process(client).children(recursive=True)
        return [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    return []


def digest(folder: Path) -> str:
    """Return a digest of all that a run has written, but for the hidden folder that a killed one may leave."""
    told = hashlib.sha256()
    for file in sorted(path for path in [*folder.glob("m.*"), *folder.glob("m.*/**/*")] if path.is_file()):
        told.update(str(file.relative_to(folder)).encode() + file.read_bytes())
    return told.hexdigest()


if __name__ == "__main__":
    main()

"""Files that were damaged anywhere: each is refused by an error of ours, or read as something usable."""

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from napari_fiberburst import Bundle, Samples, load, open_recording, read_burst, reconstruct, sample
from napari_fiberburst.io.pyramid import create_pyramid, write_frames
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.pipeline.checkpoint import Checkpoint
from napari_fiberburst.recordings.batch import read_settings
from napari_fiberburst.simulation import simulate, simulate_recording
from soak.trials import Count, wrong_with, wrong_with_burst


@dataclass(frozen=True, slots=True)
class Target:
    """A kind of file, and who reads it.

    Attributes
    ----------
    path : Path
        A file that is whole, or the one within a folder that is damaged.
    read : callable
        Without arguments.
    wrong : callable
        What is wrong with what was read; None where nothing is.
    """

    path: Path
    read: Callable[[], Any]
    wrong: Callable[[Any], str | None]


def targets(folder: Path) -> dict[str, Target]:
    """Write a file of every kind that is read, and return them by name."""
    simulated = simulate("cat", shape=(41, 47), frames=4, pitch=4.0, channels=1, seed=1)
    burst = simulated.burst
    result = reconstruct(burst, device="cpu")
    grey = np.rint(burst.frames[..., 0] * 255).astype(np.uint8)
    made: dict[str, Target] = {}

    def reads(name: str, path: Path, read: Callable[[], Any], wrong: Callable[[Any], str | None]) -> None:
        made[name] = Target(path, read, wrong)

    tif, packed, ome = folder / "a.tif", folder / "b.tif", folder / "c.ome.tif"
    tifffile.imwrite(tif, grey, photometric="minisblack")
    tifffile.imwrite(packed, grey, photometric="minisblack", compression="zlib", tile=(32, 32))
    tifffile.imwrite(ome, grey, photometric="minisblack", metadata={"axes": "TYX", "PhysicalSizeX": 0.5})
    for name, path in (("tiff", tif), ("packed", packed), ("ome", ome)):
        reads(name, path, partial(read_burst, path), wrong_with_burst)
    archive = folder / "a.burst"
    with archive.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **simulated.arrays())
    reads("simulated", archive, lambda: read_burst(archive), wrong_with_burst)
    image = folder / "z.ome.zarr"
    create_pyramid(image, (4, 41, 47), name="z", is_video=True)
    for number, frame in enumerate(grey):
        write_frames(image, number, frame[None].astype(np.float32))
    inner = [
        image / "zarr.json",
        image / "0" / "zarr.json",
        next(p for p in (image / "0" / "c").rglob("*") if p.is_file()),
    ]
    for name, path in zip(("zarr", "zarr array", "zarr chunk"), inner, strict=True):
        reads(name, path, lambda: open_recording(image).burst(range(2)), wrong_with_burst)
    clip = write_video(simulate_recording(frames=12, shape=(48, 56), pitch=4.0, seed=1).source, folder / "clip.avi")
    reads("video", clip, lambda: open_recording(clip).burst(range(4)), wrong_with_burst)
    bundle = result.bundle
    assert bundle is not None
    kept = bundle.save(folder / "probe.bundle")
    reads("bundle", kept, lambda: Bundle.load(kept), lambda value: None if value.pitch > 0 else "no pitch")
    saved = result.save(folder / "scene.npz")
    reads("result", saved, lambda: load(saved, "cpu"), wrong_with)
    model = result.save(folder / "scene.fiberburst")
    reads("model", model, lambda: load(model, "cpu"), wrong_with)
    kept_run = folder / "run.checkpoint"
    reconstruct(
        burst, encoding="fourier", features=4, scene_width=8, iterations=3, checkpoint=kept_run, checkpoint_every=1e-9
    )
    reads(
        "checkpoint", kept_run, lambda: Checkpoint.load(kept_run), lambda run: None if run.now.step > 0 else "no steps"
    )
    settings = folder / "batch.toml"
    settings.write_text("[recording]\nframe_rate = 20\n[video]\nwindow = 9\nstabilised = true\n")
    reads("settings", settings, lambda: read_settings(settings, "video"), lambda value: None)
    step = sample(burst, bundle).save(folder / "samples.safetensors")
    reads("step", step, lambda: Samples.load(step), lambda value: None)
    return made


def damaged(count: Count, each: int) -> None:
    """Damage every kind of file at random places, and read it."""
    random = np.random.default_rng(11)
    with tempfile.TemporaryDirectory() as folder:
        for name, target in targets(Path(folder)).items():
            whole = target.path.read_bytes()
            for number in range(each):
                target.path.write_bytes(_altered(whole, random))
                count.faults += 1
                count.check(target.read, target.wrong, f"{name}, damage {number}")
            target.path.write_bytes(whole)
            count.check(target.read, target.wrong, f"{name}, whole")


def fuzzed(count: Count, seconds: int) -> None:
    """Let atheris look for bytes that take each reader where no bytes before have."""
    with tempfile.TemporaryDirectory() as folder:
        # A video is decoded in a process of its own, which atheris does not follow.
        names = [name for name in targets(Path(folder)) if name != "video"]
    for name in names:
        words = [sys.executable, "-m", "soak.fuzz", name, str(seconds)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=600 + seconds)
        tried = [line for line in done.stderr.splitlines() if "stat::number_of_executed_units" in line]
        count.tried += int(tried[0].split()[-1]) if tried else 0
        if done.returncode or not tried:
            count.lose(f"{name}: {done.stderr[-2000:]}")


def _altered(whole: bytes, random: np.random.Generator) -> bytes:
    """Return a file cut short, with bytes changed, put in, taken out, or moved."""
    changed = bytearray(whole)
    place = int(random.integers(len(whole)))
    kind = int(random.integers(5))
    if kind == 0:
        return bytes(changed[:place])
    if kind == 1:
        for at in random.integers(0, len(whole), int(random.integers(1, 9))):
            changed[at] ^= 1 << int(random.integers(8))
    elif kind == 2:
        changed[place:place] = random.bytes(int(random.integers(1, 40)))
    elif kind == 3:
        del changed[place : place + int(random.integers(1, 40))]
    else:  # the heads of files have what they claim
        at = int(random.integers(min(200, len(whole))))
        changed[at : at + 4] = [b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff", bytes(4)][int(random.integers(3))]
    return bytes(changed)

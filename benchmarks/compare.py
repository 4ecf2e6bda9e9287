"""Tables 1 and 3: every method on every burst, scored against the truth in two ways.

PSNR and SSIM are of frame 0, every pixel that is visible. "Matched" is after the one gain and offset per channel that
bring the image closest to the truth: a bundle passes only part of the light, no burst can tell how large a part, and so
the quality of a method shows in the error that remains. "As given" is without: the paper prints it of a captured frame,
and it depends mostly on how dark a method leaves its image.
"""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from benchmarks.cases import Case
from benchmarks.methods import METHODS, Effort, Outcome, PeerError
from benchmarks.results import Recorder
from benchmarks.rows import Row
from napari_fiberburst.quality import match_levels, motion_error, psnr, ssim
from napari_fiberburst.simulation import SimulatedBurst

# The third table leaves out two methods, because they would take hours on its 24 bursts.
SLOW = ("inpainting", "paper")


def compare(
    recorder: Recorder, table: str, cases: Sequence[Case], methods: Sequence[str], effort: Effort, *, images: bool
) -> None:
    """Fill the rows of a table; `images` keeps what each method draws, and the truth."""
    for case in cases:
        print(case, flush=True)
        if images:
            recorder.row(table, case.name, "truth", lambda case=case: {"image": case.make().truth[0]})  # type: ignore[misc]
        for name in methods:
            recipe = {"burst": asdict(case), **{part: getattr(effort, part) for part in METHODS[name].depends_on}}
            row = recorder.row(table, case.name, name, lambda: measure(case, name, effort, images=images), recipe)  # noqa: B023
            print(f"  {METHODS[name].label:34} {in_words(row)}", flush=True)


def measure(case: Case, name: str, effort: Effort, *, images: bool) -> Row:
    """Return one row."""
    simulated = case.make()
    try:
        outcome = METHODS[name].run(case, simulated, effort)
    except PeerError as error:
        return {"missing": str(error)}
    row = score(outcome, simulated)
    if images:
        row["image"] = match_levels(outcome.image, simulated.truth[0])
    return row


def score(outcome: Outcome, simulated: SimulatedBurst) -> Row:
    """Return how close an image and its motion come to the truth."""
    truth, image = simulated.truth[0], np.nan_to_num(outcome.image)
    row: Row = {
        **(_matched(image, truth) if simulated.visible is None else _matched_where(simulated.visible, image, truth)),
        "seconds": outcome.seconds,
        "compression": outcome.compression,
        "curve": outcome.curve,
        "notes": outcome.notes,
        "quality": outcome.quality,
    }
    if outcome.homographies is not None:
        row["motion_error"] = motion_error(outcome.homographies, simulated.homographies, truth.shape[:2])
        row["frames_used"] = int(np.isfinite(outcome.homographies).all(axis=(1, 2)).sum())
    return row


def _matched(image: NDArray[np.floating], truth: NDArray[np.floating]) -> Row:
    """Return PSNR and SSIM after `match_levels`, and as given."""
    return {"psnr": psnr(image, truth), "ssim": ssim(image, truth), **as_given(image, truth)}


def _matched_where(visible: NDArray[np.bool_], image: NDArray[np.floating], truth: NDArray[np.floating]) -> Row:
    """Return the same of the visible pixels (H, W) alone; around them SSIM's windows see the truth."""
    exact = np.asarray(truth, np.float64)
    given, matched = exact.copy(), exact.copy()
    given[visible] = image[visible]
    matched[visible] = match_levels(image[visible][None], truth[visible][None])[0]
    found: Row = {}
    for ending, shown in (("", matched), ("_as_given", given)):
        found[f"psnr{ending}"] = float(peak_signal_noise_ratio(exact[visible], shown[visible], data_range=1))
        _, similarity = structural_similarity(exact, shown, data_range=1, channel_axis=2, full=True)
        found[f"ssim{ending}"] = float(similarity[visible].mean())
    return found


def as_given(image: NDArray[np.floating], truth: NDArray[np.floating]) -> Row:
    """Return PSNR and SSIM of an image as it is, 1 as full scale."""
    exact, shown = np.asarray(truth, np.float64), np.asarray(image, np.float64)
    return {
        "psnr_as_given": float(peak_signal_noise_ratio(exact, shown, data_range=1)),
        "ssim_as_given": float(structural_similarity(exact, shown, data_range=1, channel_axis=2)),
    }


def in_words(row: Row) -> str:
    """Return a row as a line to follow a run by."""
    if "missing" in row:
        return str(row["missing"])
    line = (
        f"{row['psnr']:6.2f} dB  {row['ssim']:.3f}  (as given {row['psnr_as_given']:6.2f} dB)  {row['seconds']:7.1f} s"
    )
    return line + (f"  motion off by {row['motion_error']:.3f} px" if row.get("motion_error") is not None else "")

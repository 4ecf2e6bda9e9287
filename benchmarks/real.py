"""Table 4: the real burst. Resolution, honeycomb, and how well a frame that was left out is predicted.

Blur wins by the honeycomb, sharpening by the resolution; so the three stand together. The background image is given to
the peers that need it, and to the score; our method does not see it.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, shift, uniform_filter
from skimage.registration import phase_cross_correlation

from benchmarks import chart
from benchmarks.chart import BLACK_LEVEL, Shown, finest
from benchmarks.methods import FIXED_WIDTH, PeerError, fibrebundle
from benchmarks.results import REAL, Recorder
from benchmarks.rows import Row
from napari_fiberburst import Burst, read_burst, reconstruct
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.errors import BurstError

LEFT_OUT = (3, 6, 10)
# Radius of a core, pixels.
FOOTPRINT = 2.0
# Distance of its cores, pixels; the square that holds the bundle; the part with the chart (x0, y0, x1, y1).
PITCH = 5.28
CORNER, SIZE, SCALE = (179, 18), 925, 2
CHART = (400, 230, 850, 720)
FIELD = (0, 0, *chart.FRAME[::-1])


@dataclass(frozen=True, kw_only=True, eq=False)
class RealBurst:
    """The frames (T, H, W) and the bundle with even light before it (H, W), as recorded, and the device to use."""

    frames: NDArray[np.uint8]
    background: NDArray[np.uint8]
    device: str

    @classmethod
    def read(cls, folder: Path, device: str) -> "RealBurst":
        """Open a folder that holds burst.tif and background.tif.

        Raises
        ------
        BurstError
            They are not there, or of another size than the burst whose chart is known.
        """
        for name in ("burst.tif", "background.tif"):
            if not (folder / name).exists():
                raise BurstError(f"expected {name} in {folder}; see benchmarks/README.md for where the burst is from")
        burst = read_burst(folder / "burst.tif")
        background = tifffile.imread(folder / "background.tif")
        if burst.shape[1:3] != chart.FRAME or background.shape != chart.FRAME:
            raise BurstError(f"expected frames and background of {chart.FRAME}; got {burst.shape}, {background.shape}")
        return cls(frames=tifffile.imread(folder / "burst.tif"), background=background, device=device)


def captured(real: RealBurst, frames: NDArray[np.uint8]) -> tuple[Shown, float]:
    """Return frame 0; and the seconds it took, as all methods do."""
    return Shown(frames[0].astype(float), Canvas.over(FIELD)), 0.0


def gaussian(real: RealBurst, frames: NDArray[np.uint8]) -> tuple[Shown, float]:
    """Return frame 0, filtered."""
    start = time.perf_counter()
    image = gaussian_filter(frames[0].astype(float), FIXED_WIDTH)
    return Shown(image, Canvas.over(FIELD)), time.perf_counter() - start


def fibrebundle_single(real: RealBurst, frames: NDArray[np.uint8]) -> tuple[Shown, float]:
    """Return what PyFibreBundle makes of frame 0."""
    return _fibrebundle("single", real, frames)


def fibrebundle_super(real: RealBurst, frames: NDArray[np.uint8]) -> tuple[Shown, float]:
    """Return what PyFibreBundle makes of all frames."""
    return _fibrebundle("super", real, frames)


def default(real: RealBurst, frames: NDArray[np.uint8]) -> tuple[Shown, float]:
    """Return what `reconstruct` makes of the frames."""
    start = time.perf_counter()
    image = reconstruct(Burst(frames), device=real.device).render(scale=SCALE)
    return Shown(image, Canvas.over(FIELD, SCALE)), time.perf_counter() - start


Method = Callable[[RealBurst, NDArray[np.uint8]], tuple[Shown, float]]
METHODS: Mapping[str, Method] = {
    "captured": captured,
    "gaussian-fixed": gaussian,
    "pyfibrebundle": fibrebundle_single,
    "pyfibrebundle-sr": fibrebundle_super,
    "default": default,
}


def measure_real(recorder: Recorder, real: RealBurst, methods: tuple[str, ...]) -> None:
    """Fill the table."""
    honeycomb = captured(real, real.frames)[0].ring()
    for name in methods:
        if name not in METHODS:
            continue

        def compute(name: str = name) -> Row:
            try:
                return _measure(real, METHODS[name], honeycomb)
            except PeerError as error:
                return {"missing": str(error)}

        row = recorder.row(REAL, "chart", name, compute, {"device": real.device} if name == "default" else {})
        line = row.get(
            "missing"
        ) or "M {modulation:.2f}, finest {finest}, ring {ring_db:.1f} dB, nrmse {nrmse:.3f}, {seconds:.1f} s".format(
            **row
        )
        print(f"  {name:20} {line}", flush=True)


def _measure(real: RealBurst, method: Method, honeycomb: float) -> Row:
    shown, seconds = method(real, real.frames)
    elements = list(shown.elements())
    errors = [_prediction_error(real, method(real, np.delete(real.frames, left, axis=0))[0], left) for left in LEFT_OUT]
    profiles = {
        f"G{group}E{element}": [part.tolist() for part in shown.profile(group, element, "V")]
        for group, element in ((7, 1), (7, 4), (7, 6))
    }
    x0, y0, x1, y1 = CHART
    part = Canvas.over((x0, y0, x1, y1), SCALE).points()
    dark, light = shown.levels
    return {
        "seconds": seconds,
        "elements": elements,
        "finest": finest(elements),
        "modulation": float(np.mean([row["modulation"] for row in elements if row["group"] == 7])),
        "ring_db": 20 * np.log10(shown.ring() / honeycomb),
        "nrmse": float(np.mean(errors)),
        "profiles": profiles,
        "image": 0.9 * (shown.at(part[..., 0], part[..., 1]) - dark) / (light - dark) + 0.05,
    }


def _fibrebundle(method: str, real: RealBurst, frames: NDArray[np.uint8]) -> tuple[Shown, float]:
    image, seconds = fibrebundle(
        method,
        frames=np.maximum(frames.astype(np.float64) - BLACK_LEVEL, 0)[..., None] / 255,
        bundle=np.maximum(real.background.astype(np.float64) - BLACK_LEVEL, 0) / 255,
        pitch=PITCH,
        x=float(CORNER[0]),
        y=float(CORNER[1]),
        size=SIZE,
        grid=SCALE * SIZE,
    )
    # Its pixels reach from the centre of the first pixel of the square to that of the last.
    step = (SIZE - 1) / (SCALE * SIZE - 1)
    matrix = np.array([[step, 0, CORNER[0]], [0, step, CORNER[1]], [0, 0, 1]])
    return Shown(image[..., 0], Canvas(shape=image.shape[:2], reference_from_image=matrix)), seconds


def _prediction_error(real: RealBurst, shown: Shown, left: int) -> float:
    """Return by how much the cores of a frame that was left out are missed, in standard deviations of what they show.

    After one gain and offset; of the cores over the chart alone. A core is measured by 3 x 3 pixels at its centre, and
    predicted by the image's mean over a disc of its size: single pixels on either side would measure the camera's
    noise, and punish sharp images.
    """
    flat = np.maximum(real.background.astype(float) - BLACK_LEVEL, 1)
    centres = _core_places(flat)
    x, y = centres - _shift(real, flat, left)
    inside = (x > CHART[0]) & (x < CHART[2]) & (y > CHART[1]) & (y < CHART[3])
    column, row = centres[:, inside].astype(int)
    light, even = (uniform_filter(part, 3) for part in (real.frames[left].astype(float) - BLACK_LEVEL, flat))
    measured = light[row, column] / even[row, column]
    steps = np.arange(-FOOTPRINT, FOOTPRINT + 0.1, 0.5)
    disc = [(right, down) for right in steps for down in steps if np.hypot(right, down) <= FOOTPRINT]
    predicted = np.mean([shown.at(x[inside] + right, y[inside] + down) for right, down in disc], axis=0)
    missed = measured - np.polyval(np.polyfit(predicted, measured, 1), predicted)
    return float(missed.std() / measured.std())


def _core_places(flat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixels (2, N) as (x, y) of the background's local maxima: its cores."""
    smooth = gaussian_filter(flat, PITCH / 5)
    peaks = (smooth == maximum_filter(smooth, size=3)) & (flat > 40)
    return np.argwhere(peaks)[:, ::-1].T.astype(float)


def _shift(real: RealBurst, flat: NDArray[np.float64], number: int) -> NDArray[np.float64]:
    """Return how far the object has moved since frame 0, (2, 1) as (x, y), from flat-fielded, smoothed frames."""
    weight = np.maximum(gaussian_filter(flat, PITCH / 2), 10)
    first, then = (
        gaussian_filter(np.maximum(frame.astype(float) - BLACK_LEVEL, 0), PITCH / 2) / weight
        for frame in (real.frames[0], real.frames[number])
    )
    x0, y0, x1, y1 = CHART
    window = np.outer(np.hanning(y1 - y0), np.hanning(x1 - x0))
    moved = np.zeros(2)
    for _ in range(3):  # the window stands still, which pulls each estimate towards none
        parts = [seen[y0:y1, x0:x1] for seen in (first, shift(then, -moved, order=1, mode="nearest"))]
        at, still = ((part - part.mean()) * window for part in reversed(parts))
        moved += phase_cross_correlation(at, still, upsample_factor=50, normalization=None)[0]
    return moved[::-1, None]

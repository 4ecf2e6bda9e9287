"""Reconstruction: the image a burst gave, how its frames lie on it, and where it all came from."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from operator import index
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.io.picture import as_picture, write_png
from napari_fiberburst.io.results import (
    check_output,
    is_model,
    is_picture,
    is_representation,
    versions,
    write_image,
    write_representation,
)
from napari_fiberburst.results.diagnostics import Diagnostics, Ending
from napari_fiberburst.results.model import Model, compression
from napari_fiberburst.settings import Settings

_BAND_PIXELS = 2**17
_NOTHING = np.array(None, dtype=object)


def draw(renderer: "Renderer", canvas: Canvas, frame: int, acquisition: Acquisition) -> NDArray[np.float32]:
    """Draw the scene as `frame` sees it, on a canvas in that frame's pixels, in the recording's intensity units.

    Rows are drawn some at a time, so that what is in memory beside the image does not grow with it.
    """
    height, width = canvas.shape
    band = max(1, _BAND_PIXELS // width)
    image = np.empty((height, width, acquisition.shape[3]), np.float32)
    for first in range(0, height, band):
        image[first : first + band] = renderer.render(canvas.points(first, first + band), frame)
    return acquisition.in_original_units(image)


class Renderer(Protocol):
    """What a solver hands over to make images of the scene it has fitted."""

    def render(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float32]:
        """Return the scene as `frame` sees it, (H, W, C) in [0, 1], at that frame's pixels `points` (H, W, 2)."""

    def displacement(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float64]:
        """Return the displacement of each of a frame's pixels `points` to its frame-0 pixel, (H, W, 2) in pixels."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the fitted parameters by name."""


class Look(Protocol):
    """What draws the scene of a run as it will be at other settings, while somebody turns them."""

    def image(
        self, *, smoothness: float | None = None, leave_out: Collection[int] = ()
    ) -> tuple[NDArray[np.float32], Canvas]:
        """Return the image in the burst's intensity units, and where it lies."""


class Solver(Protocol):
    """What a run leaves behind to solve its scene again."""

    def solve(self, *, smoothness: float | None = None, leave_out: Collection[int] = ()) -> "Reconstruction":
        """Solve and judge the scene, as `Reconstruction.solve_again` does."""

    def look(self) -> Look:
        """Return what draws the scene at other settings, many times as fast as it is solved and judged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction(Diagnostics):
    """A clean image of the scene, the motion of the burst, and how they were made.

    Attributes
    ----------
    image : numpy.ndarray
        (H, W) or (H, W, C) float32 in the burst's original intensity units, on the canvas. Not clipped.
    canvas : Canvas
        Where the image lies in frame-0 pixels; frame 0's field at scale 1.
    homographies : numpy.ndarray
        (T, 3, 3) float64, frame-t pixel (x, y) to frame-0 pixel; [0] is the identity. All are identities for
        motion none and for optical flow (see `flow`).
    losses : numpy.ndarray
        (steps,) float32, each step's mean squared error with intensities in [-1, 1], plus the motion's prior; the
        steps of the run it continued are in front.
    requested : Settings
        What was asked for.
    settings : Settings
        What it was made with: all that was left open is chosen (`Settings.left_open` is empty), `iterations` are the
        steps or rounds that were done, those of a run it continued included. Where not even one was done, they are
        those that were planned.
    seconds : float
        Time from the first step on, pauses left out, the run it continued included.
    parameters : int
        Numbers that were fitted.
    compression : float
        1 - bytes of the parameters as float32 / bytes of the burst as it came.
    device : str
        Where it was computed.
    ending : str
        Why the run ended: "finished", "stopped", "time budget", or "diverged", where the loss turned NaN and this
        is the last good state.
    acquisition : Acquisition
        What is known of the burst.
    solver : Solver or None
        What `solve_again` needs of the run: samples and a first scene, some MB. None where the scene is no spline, the
        run was stopped, or the result was read from a file.
    made_with : mapping
        "software", and "versions" of it, of Python, and of the packages that decide its figures.

    Notes
    -----
    What the image rests on (`coverage`, `uncertainty`, `held_out_rmse`, `cores` and more) is described at
    `napari_fiberburst.results.diagnostics.Diagnostics`. "Frame 0" stands for the frame `reference` wherever that is
    another.
    """

    image: NDArray[np.float32]
    canvas: Canvas
    homographies: NDArray[np.float64]
    losses: NDArray[np.float32]
    requested: Settings
    settings: Settings
    seconds: float
    parameters: int
    device: str
    ending: Ending
    acquisition: Acquisition
    renderer: Renderer = field(repr=False)
    solver: Solver | None = field(default=None, repr=False)
    made_with: Mapping[str, Any] = field(default_factory=versions, repr=False)

    def __repr__(self) -> str:
        """Return what it is in a line: its arrays would fill screens."""
        shape = " x ".join(map(str, self.image.shape))
        told = "" if self.quality is None else f", {self.quality}"
        return f"Reconstruction({shape} of {self.acquisition.shape[0]} frames, {self.ending}{told})"

    @property
    def compression(self) -> float:
        """1 - bytes of the parameters as float32 / bytes of the burst as it came; below 0 it takes more room."""
        return compression(self.parameters, self.acquisition)

    def solve_again(self, *, smoothness: float | None = None, leave_out: Collection[int] = ()) -> "Reconstruction":
        """Solve the scene once more from where its frames lie, at another smoothness or from other frames.

        Nothing is registered anew, so it takes a part of the time of the run. The result is a reconstruction like any
        other, judged anew; `reconstruct(burst, preset=result.requested)` comes to the same bits.

        Parameters
        ----------
        smoothness : float, optional
            Weight of the smoothness prior; more is smoother. By default the burst chooses it.
        leave_out : collection of int
            Frames to leave out, all others that were registered take part. It takes longer than another smoothness,
            because what is known of gains and outliers rests on the frames.

        Raises
        ------
        SettingsError
            There is nothing to solve again (`solver` is None), a value is out of range, or no frame is left.
        """
        if self.solver is None:
            raise SettingsError(
                "only a spline that was solved in this process, to its end, can be solved again; run the burst anew "
                "with encoding 'spline'"
            )
        return self.solver.solve(smoothness=smoothness, leave_out=leave_out)

    def render(
        self, scale: float = 1.0, bounds: tuple[float, float, float, float] | None = None
    ) -> NDArray[np.float32]:
        """Draw the scene as frame 0 sees it.

        Parameters
        ----------
        scale : float
            Image pixels to a frame-0 pixel; 2 doubles both sides.
        bounds : (float, float, float, float), optional
            x0, y0, x1, y1 in frame-0 pixels, half-open; default frame 0's field. They may reach beyond it, where
            only other frames have looked, or none. Behind a calibrated bundle what no core has looked at is NaN; a
            network fitted as published marks nothing.

        Returns
        -------
        numpy.ndarray
            (H, W) or (H, W, C) float32 in the burst's intensity units, on ``Canvas.over(bounds, scale)``.

        Raises
        ------
        SettingsError
            The bounds are empty or the scale is not positive.
        """
        canvas = Canvas.over(self._field if bounds is None else bounds, scale)
        return draw(self.renderer, canvas, self.reference, self.acquisition)

    def frame(self, t: int, scale: float = 1.0) -> NDArray[np.float32]:
        """Draw the clean scene as frame t sees it, I_hat(x, y, t) = f(gamma(T_g(x, y, t))).

        Parameters
        ----------
        t : int
            Frame number; negative ones count from the end.
        scale : float
            Image pixels to a frame pixel.

        Returns
        -------
        numpy.ndarray
            (H, W) or (H, W, C) float32 in the burst's intensity units. Behind a calibrated bundle, NaN beyond the
            canvas and a margin about it, and for frames that were left out.

        Raises
        ------
        IndexError
            There is no such frame.
        SettingsError
            The scale is not positive.
        """
        return draw(self.renderer, Canvas.over(self._field, scale), self._number(t), self.acquisition)

    def flow(self, t: int) -> NDArray[np.float64]:
        """Return how far frame t's pixels are from where frame 0 shows the same point of the object.

        Parameters
        ----------
        t : int
            Frame number; negative ones count from the end.

        Returns
        -------
        numpy.ndarray
            (H, W, 2) as (x, y) in pixels: frame-t pixel + flow = frame-0 pixel, whatever the motion's model; 0 for
            motion none. NaN where frame 0 shows the point nowhere, because its own flow folds.

        Raises
        ------
        IndexError
            There is no such frame.
        """
        return self.renderer.displacement(Canvas.over(self._field).points(), self._number(t))

    def displacement(self, t: int) -> NDArray[np.float64]:
        """How frame `t` bends beyond its homography.

        Parameters
        ----------
        t : int
            Frame number; negative ones count from the end.

        Returns
        -------
        numpy.ndarray
            (H, W, 2) as (x, y) in pixels of frame 0, at each of the frame's pixels: `flow` less what the homography
            does; 0 where frames do not bend. NaN for a frame that does not take part.

        Raises
        ------
        IndexError
            There is no such frame.
        """
        points = Canvas.over(self._field).points()
        return self.flow(t) + points - transform_points(self.homographies[self._number(t)], points)

    @property
    def bends(self) -> bool:
        """Whether frames are moved by more than their homographies; `displacement` tells by how much."""
        return self.settings.method.motion.bends is not False

    def provenance(self) -> dict[str, Any]:
        """Return where the image came from, as plain values that JSON can hold; None stands for NaN."""
        return {
            **self.made_with,
            "requested": self.requested.to_dict(),
            "settings": self.settings.to_dict(),
            "seed": self.settings.seed,
            "device": self.device,
            "ending": self.ending,
            "seconds": self.seconds,
            "parameters": self.parameters,
            "compression": self.compression,
            "canvas": {
                "shape": self.canvas.shape,
                "reference_from_image": self.canvas.reference_from_image.tolist(),
            },
            "burst": self.acquisition.to_dict(),
            "homographies": np.where(
                np.isfinite(self.homographies), self.homographies.astype(object), _NOTHING
            ).tolist(),
            "losses": [float(loss) if np.isfinite(loss) else None for loss in self.losses],
            **self.summary(),
        }

    def save(self, path: str | Path) -> Path:
        """Write all that the result has, the image, a picture of it, or what it is drawn from.

        Parameters
        ----------
        path : str or Path
            ``.fiberburst``: a model, which `napari_fiberburst.load` reads back as this result, without the burst: what
            the image rests on too, drawn at any size, or continued (without Adam's moments). `solver` is left out.
            ``.ome.tif`` (or ``.tif``): the image as OME-TIFF with pixel size and channel names, and its
            provenance as JSON beside it. ``.png``: a picture to look at, 8 bits, from the darkest to the brightest
            thousandth, see-through where the image is NaN. ``.npz``: what the image is drawn from, as 0.1.0 wrote
            it, to be read back without what the image rests on.

        Returns
        -------
        Path
            The file written.

        Raises
        ------
        OutputError
            The folder does not exist or cannot be written, or the ending is not one of these. Files are replaced
            whole: a killed run leaves the old one or the new one, never half of one.
        """
        if is_model(Path(path)):
            return Model.of(self).save(path)
        if is_representation(Path(path)):
            return write_representation(path, self.renderer.arrays(), self.provenance())
        if is_picture(Path(path)):
            return write_png(check_output(path), as_picture(self.image))
        return write_image(path, self.image, self.acquisition, self.provenance())

    @property
    def _field(self) -> tuple[float, float, float, float]:
        return 0, 0, self.acquisition.shape[2], self.acquisition.shape[1]

    def _number(self, t: int) -> int:
        count, t = len(self.homographies), index(t)
        if not -count <= t < count:
            raise IndexError(f"frame {t} of a burst of {count}")
        return t % count

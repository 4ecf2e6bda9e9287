"""The model file: all that a result has, to be opened without its burst."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Acquisition, check_acquisition
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.io.results import MODEL_ENDING, SOFTWARE
from napari_fiberburst.results.diagnostics import Diagnostics, Ending, Quality
from napari_fiberburst.settings import Settings
from napari_fiberburst.stored import Arrays, Stored

if TYPE_CHECKING:
    from napari_fiberburst.results.reconstruction import Reconstruction, Renderer

# What a result and its file have under one name.
_ALIKE = ("image", "canvas", "homographies", "losses", "seconds", "parameters", "device", "ending", "made_with")
# No canvas reaches so many pixels from the reference frame.
_FAR = 1e9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Model(Stored):
    """A `Reconstruction` as it lies in a file: arrays, and plain values.

    Attributes
    ----------
    requested, settings, acquisition : mapping
        As their `to_dict` returns them.
    diagnostics : Diagnostics
        What the image rests on.
    drawn_from : dict
        What its renderer needs, by name.

    Notes
    -----
    The other attributes are those of the result. Reading one takes no torch, until it is to be drawn.
    """

    _kind: ClassVar[str] = "model"
    _ending: ClassVar[str] = MODEL_ENDING

    image: NDArray[np.float32]
    canvas: Canvas
    homographies: NDArray[np.float64]
    losses: NDArray[np.float32]
    requested: Mapping[str, Any]
    settings: Mapping[str, Any]
    seconds: float
    parameters: int
    device: str
    ending: Ending
    acquisition: Mapping[str, Any]
    diagnostics: Diagnostics
    drawn_from: Arrays
    made_with: Mapping[str, Any]

    @classmethod
    def of(cls, result: "Reconstruction") -> "Model":
        """Take a result apart."""
        return cls(
            **{name: getattr(result, name) for name in _ALIKE},
            requested=result.requested.to_dict(),
            settings=result.settings.to_dict(),
            acquisition=result.acquisition.to_dict(),
            diagnostics=Diagnostics(**result.by_name()),
            drawn_from=result.renderer.arrays(),
        )

    def result(self, renderer: "Renderer") -> "Reconstruction":
        """Put the result together again, with what draws `drawn_from`."""
        from napari_fiberburst.results.reconstruction import Reconstruction  # which is saved by this module

        return Reconstruction(
            **{name: getattr(self, name) for name in _ALIKE},
            requested=Settings.from_dict(self.requested),
            settings=Settings.from_dict(self.settings),
            acquisition=self.taken,
            renderer=renderer,
            **{item.name: getattr(self.diagnostics, item.name) for item in fields(Diagnostics)},
        )

    @property
    def compression(self) -> float:
        """As that of a result."""
        return compression(self.parameters, self.taken)

    @property
    def taken(self) -> Acquisition:
        """What is known of the burst."""
        return Acquisition.from_dict(self.acquisition)

    def _check(self) -> None:
        """Refuse contents that do not belong together."""
        check_acquisition(self.taken)
        frames, height, width, channels = self.taken.shape
        shape = self.canvas.shape
        known: list[tuple[str, Any, str, tuple[int | None, ...]]] = [
            ("image", self.image, "float32", shape if self.taken.axes == "TYX" else (*shape, channels)),
            ("canvas", self.canvas.reference_from_image, "float64", (3, 3)),
            ("homographies", self.homographies, "float64", (frames, 3, 3)),
            ("losses", self.losses, "float32", (None,)),
            *self._evidence(shape, frames),
        ]
        for name, array, dtype, wanted in known:
            _check_array(name, array, dtype, wanted)
        _check_canvas(self.canvas.reference_from_image)
        bundle, told = self.diagnostics.bundle, self.diagnostics
        if bundle is not None:
            bundle._check()
            if bundle.shape != (height, width):
                raise ValueError(f"the bundle of shape {bundle.shape} is not that of frames of {height} x {width}")
        if not 0 <= told.reference < frames or not set(told.frames_used or ()) <= set(range(frames)):
            raise ValueError(f"a burst of {frames} frames cannot have used {told.frames_used} of {told.reference}")
        is_known = np.array([np.isfinite(one).all() for one in self.homographies])
        if not is_known[told.reference] or not np.linalg.det(self.homographies[is_known]).all():
            raise ValueError(f"frame {told.reference}, the reference, lies nowhere, or another frame has no size")
        self._check_words()

    def _check_words(self) -> None:
        """Refuse plain values that no run has."""
        told = self.diagnostics
        if self.ending not in get_args(Ending) or told.quality not in (*get_args(Quality), None):
            raise ValueError(f"no run ends as {self.ending!r} with a verdict of {told.quality!r}")
        if not all(isinstance(note, str) for note in told.notes):
            raise ValueError("notes must be text")
        versions = self.made_with["versions"]
        if self.made_with.get("software") != SOFTWARE or not all(isinstance(one, str) for one in versions.values()):
            raise ValueError(f"it was made with {self.made_with}, which is not {SOFTWARE} in a version")
        numbers = (self.seconds, self.parameters, told.misfit, told.held_out_rmse, told.resolution)
        if not all(one is None or isinstance(one, int | float) for one in numbers) or not 0 <= self.seconds < np.inf:
            raise ValueError(f"expected numbers, and seconds of a run; got {numbers}")
        if not isinstance(self.parameters, int) or not 0 <= self.parameters < 2**63:
            raise ValueError(f"no scene has {self.parameters} parameters")

    def _evidence(self, shape: tuple[int, int], frames: int) -> list[tuple[str, Any, str, tuple[int | None, ...]]]:
        """Return name, array, type and shape of what is known beside the image."""
        told = self.diagnostics
        cores = None if told.bundle is None else len(told.bundle.centres)
        expected: dict[str, tuple[str, tuple[int | None, ...]]] = {
            "coverage": ("float32", shape),
            "context": ("int32", shape),
            "uncertainty": ("float32", shape),
            "gain_ratios": ("float32", (cores,)),
            "gain_weights": ("float32", (cores,)),
            "residuals": ("float32", (frames, cores)),
            "outliers": ("bool", (frames, cores)),
            "exposures": ("float64", (frames,)),
            "confidence": ("float64", (frames,)),
        }
        found = [(name, getattr(told, name), *what) for name, what in expected.items()]
        if told.agreement is not None:
            found += [
                (name, getattr(told.agreement, name), "float64", (None,)) for name in ("frequency", "correlation")
            ]
        return [one for one in found if one[1] is not None]


def compression(parameters: int, acquisition: Acquisition) -> float:
    """Return 1 - bytes of the parameters as float32 / bytes of the burst as it came; below 0 they take more room."""
    return 1 - 4 * parameters / acquisition.nbytes


def _check_canvas(reference_from_image: NDArray[np.float64]) -> None:
    step_x, step_y = np.diag(reference_from_image)[:2]
    first = reference_from_image[:2, 2]
    expected = np.array([[step_x, 0, first[0]], [0, step_y, first[1]], [0, 0, 1]])
    if not (
        np.array_equal(reference_from_image, expected) and 0 < min(step_x, step_y) and np.abs(expected).max() < _FAR
    ):
        raise ValueError(f"no canvas lies at {reference_from_image.tolist()}")


def _check_array(name: str, array: Any, dtype: str, wanted: tuple[int | None, ...]) -> None:
    if not isinstance(array, np.ndarray) or array.dtype != dtype or array.ndim != len(wanted):
        kind = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else repr(array)
        raise ValueError(f"{name} is {kind}, expected {dtype} with {len(wanted)} axes")
    if any(side not in (None, have) for side, have in zip(wanted, array.shape, strict=True)):
        raise ValueError(f"{name} is of shape {array.shape}, expected {wanted}")

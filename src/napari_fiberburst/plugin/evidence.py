"""What an image rests on, as layers: each is made when somebody asks for it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from napari.layers import Image, Layer, Shapes, Tracks, Vectors
from numpy.typing import NDArray

from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.io.picture import limits_of
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.stacks import residual_maps, stabilised

if TYPE_CHECKING:
    from napari_fiberburst.data.canvas import Canvas
    from napari_fiberburst.results.reconstruction import Reconstruction

# What there is, in the order it is offered.
KINDS = {
    "outlines": "Where each frame lies on the image; follows the slider. Ctrl + click (Cmd on a Mac) inside one leaves "
    "its frame out, or takes it in again; one that is left out is dashed and grey.",
    "path": "The way of the frames' centres.",
    "coverage": "How many core samples saw each pixel; 0 is filled in from the surroundings.",
    "frames": "How many frames have seen each pixel.",
    "uncertainty": "The standard deviation to be expected from noise and gaps, in intensity units.",
    "transmission": "The light that each frame pixel passes, 1 for a bright core.",
    "residuals": "By how much the model misses each core in each frame; shows objects that moved by themselves.",
    "left out": "Cores that show something else than the object in a frame, and do not count there.",
    "displacement": "Arrows where frames bend beyond their homographies, enlarged three times.",
    "stabilised burst": "The frames as they came, moved into place; each is warped when it is shown.",
}
# Those that are known while a run goes: they follow from the motion alone.
MOTION_KINDS = ("outlines", "path")
_EDGE, _TRACK_COLOURS = "#ffb000", "turbo"
# Of a frame that was left out: its dashes, so many a side, and its outline, which can be clicked all the same.
_GREY, _UNSEEN, _DASHES = "#909090", "transparent", 9
# Outlines of frames that bend have so many points a side; arrows that show how, so many along the frame's longer side,
# and are so much longer than the way they show.
_PER_SIDE, _ARROWS, _ENLARGED = 12, 16, 3.0
# An outline is as wide as this part of the frame.
_FRAME_PER_EDGE = 200
# Above this one, residuals are shown in the brightest colour.
_RESIDUAL_PERCENTILE = 99.0

Shift = Callable[[NDArray[np.float64], int], NDArray[np.float64]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """How the frames of a run lie on its image.

    Attributes
    ----------
    homographies : numpy.ndarray
        (T, 3, 3), frame-t pixel to frame-0 pixel; NaN where it is not known.
    shape : (int, int)
        Height and width of a frame.
    shift : callable or None
        Where frames bend: from a frame's pixels (N, 2) and its number to the way (N, 2) to their frame-0 pixels.
    left_out : tuple of int
        Frames that the image is made without.
    """

    homographies: NDArray[np.float64]
    shape: tuple[int, int]
    shift: Shift | None = None
    left_out: tuple[int, ...] = ()

    @property
    def known(self) -> list[int]:
        """Numbers of the frames whose motion is known."""
        return [frame for frame, matrix in enumerate(self.homographies) if np.isfinite(matrix).all()]

    def moved(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float64]:
        """Return where a frame's points (N, 2) lie in the reference frame's pixels.

        What that frame shows nowhere, because its flow folds, lies where it would if frames did not bend.
        """
        placed = self.placed(points, frame)
        if self.shift is None:
            return placed
        moved = points + self.shift(points, frame)
        return np.where(np.isfinite(moved).all(axis=1, keepdims=True), moved, placed)

    def placed(self, points: NDArray[np.float64], frame: int) -> NDArray[np.float64]:
        """Return where they would lie if frames did not bend."""
        return transform_points(self.homographies[frame], points)


def motion_of(result: "Reconstruction") -> Motion:
    """Return how the frames of a result lie on its image."""
    shift = (lambda points, frame: result.renderer.displacement(points[None], frame)[0]) if result.bends else None
    left_out = result.settings.flat().get("leave_out", ())
    return Motion(homographies=result.homographies, shape=result.acquisition.shape[1:3], shift=shift, left_out=left_out)


def kinds_of(result: "Reconstruction", placement: Placement) -> tuple[str, ...]:
    """Return what there is to show of a result."""
    has_time = "T" in placement.axes
    bundle, residuals, outliers = result.bundle, result.residuals, result.outliers
    has_cores = bundle is not None and bundle.is_resolved
    there_is = {
        "outlines": has_time,
        "path": has_time,
        "coverage": result.coverage is not None,
        "frames": result.context is not None,
        "uncertainty": result.uncertainty is not None,
        "transmission": bundle is not None,
        "residuals": has_cores and residuals is not None and bool(np.isfinite(residuals).any()),
        "left out": has_cores and outliers is not None and bool(outliers.any()),
        "displacement": has_time and result.bends,
        "stabilised burst": has_time,
    }
    return tuple(kind for kind in KINDS if there_is[kind])


def outlines(motion: Motion, placement: Placement) -> Any:
    """Return a polygon for each frame, then the dashes of those left out, as a Shapes layer takes them."""
    height, width = motion.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    sides = corners
    if motion.shift is not None:
        sides = np.linspace(corners, np.roll(corners, -1, axis=0), _PER_SIDE, axis=1)[:, :-1].reshape(-1, 2)
    drawn = [
        (one, "polygon") for frame in motion.known for one in placement.vertices(motion.moved(sides, frame), frame)
    ]
    for frame in _left_out(motion):
        for ends in _dashes(corners):
            drawn += [(one, "line") for one in placement.vertices(motion.moved(ends, frame), frame)]
    return drawn


def outlined_frames(motion: Motion, placement: Placement) -> list[int]:
    """Return the frame of each shape of `outlines`."""
    dashed = [frame for frame in _left_out(motion) for _ in range(4 * _DASHES)]
    return [frame for frame in (*motion.known, *dashed) for _ in range(_positions(placement))]


def outline_look(motion: Motion, placement: Placement) -> dict[str, Any]:
    """Return colour and width of each shape of `outlines`: of a frame left out, only grey dashes are seen."""
    frames, polygons = outlined_frames(motion, placement), len(motion.known) * _positions(placement)
    colours = [_UNSEEN if frame in motion.left_out else _EDGE for frame in frames[:polygons]]
    return {
        "edge_color": colours + [_GREY] * (len(frames) - polygons),
        "edge_width": [max(1.0, motion.shape[1] / _FRAME_PER_EDGE)] * len(frames),
    }


def _positions(placement: Placement) -> int:
    """Return at how many positions of other axes each shape is drawn."""
    return int(np.prod([placement.sizes[axis] for axis in placement.axes if axis not in "TYX"]))


def _left_out(motion: Motion) -> list[int]:
    return [frame for frame in motion.known if frame in motion.left_out]


def _dashes(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return both ends (N, 2, 2) of each dash along the sides between corners (4, 2)."""
    # A dash is as long as a gap, and each side begins and ends with half a gap.
    begin = (np.arange(_DASHES) + 0.25) / _DASHES
    at = np.stack([begin, begin + 0.5 / _DASHES], axis=1)[:, :, None]
    ways = np.roll(corners, -1, axis=0) - corners
    return np.concatenate([corner + at * way for corner, way in zip(corners, ways, strict=True)])


def path(motion: Motion, placement: Placement) -> Any:
    """Return the frames' centres, as a Tracks layer takes them."""
    height, width = motion.shape
    centre = np.array([[width - 1.0, height - 1.0]]) / 2
    # One track for each position of axes that are neither time nor space.
    tracks = zip(*(placement.vertices(motion.moved(centre, frame), frame) for frame in motion.known), strict=True)
    return np.array([[number, *point[0]] for number, track in enumerate(tracks) for point in track])


def motion_layer(kind: str, motion: Motion, placement: Placement) -> Layer:
    """Make the layer of outlines or of the path."""
    placed = placement.on_canvas(placement.axes)
    if kind == "outlines":
        look = {"face_color": "transparent", **outline_look(motion, placement)}
        return Shapes(outlines(motion, placement), **look, **placed)
    return Tracks(path(motion, placement), tail_length=len(motion.homographies), colormap=_TRACK_COLOURS, **placed)


def result_layers(kind: str, result: "Reconstruction", frames: Any, placement: Placement) -> Mapping[str, Layer]:
    """Make the layers of one kind, by name: one, or one for each channel where these are layers.

    Parameters
    ----------
    kind : str
        One of `kinds_of`.
    result : Reconstruction
        What has come of a run.
    frames : array
        The burst as it came, (T, H, W) or (T, H, W, C).
    placement : Placement
        Where the burst is.
    """
    canvas, bundle = result.canvas, result.bundle
    match kind:
        case "outlines" | "path":
            return {kind: motion_layer(kind, motion_of(result), placement)}
        case "displacement":
            return {kind: _arrows(motion_of(result), placement)}
        case "stabilised burst":
            return _stabilised(result, frames, placement)
        case "coverage":
            return {kind: _image(result.coverage, "YX", placement, canvas, colormap="viridis")}
        case "frames":
            return {kind: _image(result.context, "YX", placement, canvas, colormap="viridis")}
        case "uncertainty":
            return {kind: _image(result.uncertainty, "YX", placement, canvas, colormap="magma")}
    assert bundle is not None  # by `kinds_of`
    if kind == "transmission":
        return {kind: _image(bundle.transmission, "YX", placement)}
    if kind == "residuals":
        assert result.residuals is not None
        high = float(np.nanpercentile(result.residuals, _RESIDUAL_PERCENTILE)) or 1.0
        maps = residual_maps(result.residuals, bundle.labels)
        return {kind: _image(maps, "TYX", placement, colormap="inferno", contrast_limits=(0.0, high))}
    assert result.outliers is not None
    maps = residual_maps(result.outliers.astype(np.float32), bundle.labels)
    # Over the frames, which show what was left out.
    look: dict[str, Any] = {"colormap": "magenta", "contrast_limits": (0.0, 1.0), "blending": "additive"}
    return {kind: _image(maps, "TYX", placement, **look)}


def _image(array: Any, axes: str, placement: Placement, canvas: "Canvas | None" = None, **look: Any) -> Image:
    if "contrast_limits" not in look:
        # napari's own guess takes what is infinite, and one odd pixel, for the whole range.
        low, high = limits_of(array)
        look |= {"contrast_limits": (low, high)} if high > low else {}
    data, axes = (array, axes) if look.get("rgb") else placement.arrange(array, axes)
    return Image(data, **placement.on_canvas(axes, canvas), **look)


def _stabilised(result: "Reconstruction", frames: Any, placement: Placement) -> dict[str, Layer]:
    kind, flow = "stabilised burst", result.flow if result.bends else None
    still = stabilised(frames, result.homographies, result.canvas, flow)
    looks = [
        {"contrast_limits": limits} if placement.rgb else {"contrast_limits": limits, "colormap": colormap}
        for limits, colormap in zip(placement.limits, placement.colormaps, strict=True)
    ]
    if placement.channels:
        return {
            f"{kind} of {name}": _image(
                still[..., number], "TYX", placement, result.canvas, blending="additive", **looks[number]
            )
            for number, name in enumerate(placement.channels)
        }
    if placement.rgb:
        return {kind: _image(still, "TYX", placement, result.canvas, rgb=True, **looks[0])}
    return {kind: _image(still, "TYXC"[: still.ndim], placement, result.canvas, **looks[0])}


def _arrows(motion: Motion, placement: Placement) -> Vectors:
    """Return an arrow (N, 2, D) wherever frames bend."""
    height, width = motion.shape
    step = max(height, width) / _ARROWS
    y, x = np.mgrid[step / 2 : height : step, step / 2 : width : step]
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    parts = []
    for frame in motion.known:
        places = motion.moved(points, frame)
        ways = places - motion.placed(points, frame)
        starts, ends = (placement.vertices(at, frame) for at in (places, places + ways))
        parts += [np.stack([start, end - start], axis=1) for start, end in zip(starts, ends, strict=True)]
    look = {"length": _ENLARGED, "edge_color": _EDGE, "vector_style": "arrow"}
    return Vectors(np.concatenate(parts), **look, **placement.on_canvas(placement.axes))

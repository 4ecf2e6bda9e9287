"""The field: where frames show the object, as against black surroundings and marks that were drawn into them.

The object moves, so light that changes from frame to frame lies in the field. Surroundings are dark and do not change;
a logo or a scale bar is bright and does not change. Both stand still, and registration would lock onto them.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.samples import SATURATED, only_exposed
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.operators.filters import local_mean

# Light, and how much it changes, are averaged over so many pixels, or pitches if that is more: gaps between cores are
# no surroundings.
_SMOOTHING, _SMOOTHING_PITCHES = 3.0, 0.4
# A place is dark below this part of the light of a bright one, above black. The darkest place of an image without black
# in it is not dark: what has more than the second part of a bright place's light, black level included, never is.
_DARK, _DARK_WITH_BLACK = 0.04, 0.25
# Surroundings are black: most of them are below this part of the light of a bright place, above the darkest.
_BLACK = 0.012
# Light changes where its standard deviation over time is at least this part of its upper quartile, both above that of
# dark places, which is noise. It changes nowhere if the upper quartile is less than so many times the noise.
_LEAST_CHANGE, _LEAST_OVER_NOISE = 1 / 6, 2.0
# Where dark surroundings take less than this part of the frame, the field is all of it.
_LEAST_SURROUNDINGS = 0.02
# Pixels: parts of the field that are thinner than twice this are letters, or noise. Relative to its largest part:
# smaller ones are clocks and other marks that change.
_THIN, _LEAST_PART = 3, 0.1
# A field stands still: in the median frame light reaches over this part of it at least. An object on a dark ground
# takes its outline along.
_LEAST_REACH = 0.97
# Light fills a field, which is convex, to this part of it at least. Cells on a dark ground do not, and those that stand
# apart would be taken for marks.
_LEAST_FILLED = 0.85
# So many frames are asked whether it does.
_ASKED = 8
# A field takes at least this part of the frame: what is smaller is a spot of light in it.
_LEAST_FIELD = 0.1
# Of the shorter side: dark bays that are narrower than twice this belong to the object.
_BAY = 0.025
# The light fades out over a rim of so many pixels, or of this part of the shorter side if that is more.
_RIM, _RIM_OF_SIDE = 6, 0.018

# A mark is brighter than what is about it (Gaussian of so many pixels, or of this part of the shorter side) and than
# this part of a bright place. It changes less than the first part of what changes about it, and less than the second
# part of what those bright pixels change that hardly do but do (so many of them, where more than the last part of the
# upper decile changes about them): these have noise.
_AROUND, _AROUND_OF_SIDE, _BRIGHT = 12.0, 0.06, 0.5
_STILL, _STILL_OF_NOISE, _HARDLY, _LIVELY = 1 / 6, 0.5, 0.02, 0.25
# Pixels that touch, and frames: fewer of either may stand still by chance.
_LEAST_MARK, _LEAST_FRAMES = 4, 4
# Pixels: edges of marks are soft.
_SOFT = 1.5

# Pixels within this of a hull's edge lie on it.
_ON_EDGE = 1e-6


def find_field(frames: Tensor, pitch: float | None = None) -> Tensor:
    """Return where frames of a moving object show it, (H, W) bool: everywhere, if no surroundings are dark.

    Dark parts of the object belong to the field where there is light about them, or where they move. In frames that do
    not change, brightness alone decides.

    Parameters
    ----------
    frames : Tensor
        (T, H, W) in [0, 1], none of them black or white.
    pitch : float, optional
        Distance of neighbouring cores, pixels, where the frames show any.
    """
    everywhere = torch.ones_like(frames[0], dtype=torch.bool)
    width = max(_SMOOTHING, _SMOOTHING_PITCHES * (pitch or 0.0))
    light = _smooth(frames.mean(dim=0), width)
    level = _dark_level(light)
    lit = light >= level
    if _share(~lit) < _LEAST_SURROUNDINGS or not _is_black(light, ~lit):
        return everywhere
    changes = _changes(_smooth(frames.std(dim=0, correction=0), width), lit)
    parts = _large_parts(ndimage.binary_opening(lit & changes, _disc(_THIN)))
    if not parts.any():
        return everywhere
    hull = _convex_hull(parts)
    if lit[hull].mean() < _LEAST_FILLED:
        return everywhere
    if _share(~hull & ~lit) < _LEAST_SURROUNDINGS or _share(hull) < _LEAST_FIELD:
        return everywhere
    if not _stands_still(frames, level, hull, width):
        return everywhere
    bays = ndimage.binary_opening(~(lit | changes), _disc(round(_BAY * min(hull.shape))))
    field = ~_joined_to_border(bays | ~hull)
    return torch.from_numpy(_large_parts(field)).to(frames.device)


def dark_places(frames: Tensor, bundle: Bundle, acquisition: Acquisition) -> Tensor | None:
    """Return where no light comes from and no core is seen, (H, W) bool: beyond the bundle, or before a dark object.

    None where the frames (T, H, W) in [0, 1] have no such place. Cores that are dead or covered have light about them.
    """
    beyond = torch.from_numpy(~bundle.outline).to(frames.device)
    if not bool(beyond.any()):
        return None
    black = bundle.black_in(acquisition)
    light = local_mean((only_exposed(frames).mean(dim=0) - black).clamp_min(0), bundle.pitch)
    lit = light[~beyond]
    if not len(lit):
        return None
    dark = beyond & (light < _DARK * float(np.quantile(lit.cpu().numpy(), 0.95)))
    return dark if bool(dark.any()) else None


def find_marks(frames: Tensor) -> Tensor:
    """Return what is burned into frames of a moving object, (H, W) bool: bright, and without even the camera's noise.

    Saturated pixels are no marks: nobody takes light from them anyway.

    Parameters
    ----------
    frames : Tensor
        (T, H, W) in [0, 1], none of them black or white.
    """
    none = torch.zeros_like(frames[0], dtype=torch.bool)
    if len(frames) < _LEAST_FRAMES:
        return none
    light, change = frames.mean(dim=0), frames.std(dim=0, correction=0)
    around = max(_AROUND, _AROUND_OF_SIDE * min(light.shape))
    least = _BRIGHT * float(np.quantile(light.cpu().numpy(), 0.95))
    bright = (light > local_mean(light, around).clamp_min(least)) & (frames.amax(dim=0) < SATURATED)
    usual = local_mean(change, around)
    lively = bright & (change > 0) & (usual > _LIVELY * float(np.quantile(usual.cpu().numpy(), 0.9)))
    if not bool(lively.any()):
        return none
    noise = float(np.quantile(change[lively].cpu().numpy(), _HARDLY))
    still = bright & (change < _STILL * usual) & (change < _STILL_OF_NOISE * noise)
    labels, _ = ndimage.label(still.cpu().numpy(), np.ones((3, 3)))
    large = np.bincount(labels.ravel()) >= _LEAST_MARK
    large[0] = False
    marks = torch.from_numpy(large[labels]).to(frames.device)
    return widened(marks, _SOFT) if bool(marks.any()) else none


def without_rim(field: Tensor) -> Tensor:
    """Return a field (H, W) without the rim over which its light fades out; it does not fade at the frame's edge."""
    if bool(field.all()):
        return field
    inner = ~widened(~field, max(_RIM, round(_RIM_OF_SIDE * min(field.shape))))
    return inner if bool(inner.any()) else field


def widened(field: Tensor, reach: float) -> Tensor:
    """Return a field (H, W) with all that lies within `reach` pixels of it."""
    distance = ndimage.distance_transform_edt(~field.cpu().numpy())
    return torch.from_numpy(distance <= reach).to(field.device)


def _smooth(image: Tensor, width: float) -> NDArray[np.float32]:
    smooth: NDArray[np.float32] = local_mean(image, width).cpu().numpy()
    return smooth


def _share(marked: NDArray[np.bool_]) -> float:
    return float(marked.mean())


def _dark_level(light: NDArray[np.float32]) -> float:
    """Return the light below which a place is dark."""
    black, bright = np.quantile(light, [0.002, 0.95])
    return float(min(black + _DARK * (bright - black), _DARK_WITH_BLACK * bright))


def _is_black(light: NDArray[np.float32], dark: NDArray[np.bool_]) -> bool:
    """Return whether dark places are evenly black, rather than the end of a slow fall of the light."""
    black, bright = np.quantile(light, [0.002, 0.95])
    return _share(light[dark] < black + _BLACK * (bright - black)) > 0.5


def _changes(change: NDArray[np.float32], lit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where light changes, by its standard deviation over time; where it is lit, if it changes nowhere."""
    noise, usual = np.median(change[~lit]), np.quantile(change[lit], 0.75)
    if usual < _LEAST_OVER_NOISE * noise or usual == 0:
        return lit
    changes: NDArray[np.bool_] = change >= noise + _LEAST_CHANGE * (usual - noise)
    return changes


def _stands_still(frames: Tensor, level: float, hull: NDArray[np.bool_], width: float) -> bool:
    """Return whether light reaches over all of the field in single frames too."""
    reached = []
    for frame in frames[:: -(-len(frames) // _ASKED)]:
        lit = ndimage.binary_opening((_smooth(frame, width) >= level) & hull, _disc(_THIN))
        reached.append(_convex_hull(lit).sum() / hull.sum() if lit.any() else 0.0)
    return float(np.median(reached)) >= _LEAST_REACH


def _large_parts(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest connected part, and others of its order."""
    labels, _ = ndimage.label(marked)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    large: NDArray[np.bool_] = (sizes >= max(1, _LEAST_PART * sizes.max()))[labels]
    return large


def _joined_to_border(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return those marked pixels from which marked ones lead out of the frame."""
    around = np.pad(marked, 1, constant_values=True)
    border = np.pad(np.zeros_like(marked), 1, constant_values=True)
    joined: NDArray[np.bool_] = ndimage.binary_propagation(border, mask=around)[1:-1, 1:-1]
    return joined


def _convex_hull(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels whose centres lie in the convex hull of those of the marked ones, which are no single line."""
    y, x = np.nonzero(marked ^ ndimage.binary_erosion(marked))
    facets = ConvexHull(np.stack([y, x], axis=1)).equations
    rows, columns = np.arange(marked.shape[0]), np.arange(marked.shape[1])
    # Each facet bounds the columns of every row on one side.
    first, last = np.zeros(len(rows)), np.full(len(rows), len(columns) - 1.0)
    for slope_y, slope_x, offset in facets:
        least = slope_y * rows + offset - _ON_EDGE
        if abs(slope_x) < _ON_EDGE:
            last[least > 0] = -1
        elif slope_x > 0:
            last = np.minimum(last, -least / slope_x)
        else:
            first = np.maximum(first, -least / slope_x)
    inside: NDArray[np.bool_] = (columns >= first[:, None]) & (columns <= last[:, None])
    return inside


def _disc(radius: int) -> NDArray[np.bool_]:
    y, x = np.ogrid[-radius : radius + 1, -radius : radius + 1]
    disc: NDArray[np.bool_] = x**2 + y**2 <= radius**2
    return disc

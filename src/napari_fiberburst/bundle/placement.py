"""Find a known bundle in frames: a probe that was plugged in again sits a few pixels away, and a little turned.

The pattern of cores is unique to a bundle, so its image is searched for, by correlation over shifts at a row of
angles, in the mean of the frames with slow changes divided out. Then every core is looked for where it should be, and
a rigid motion is fitted to what was found. How many cores are where they should be, and how alike their brightness is,
tells this bundle from another one, and a change of zoom shows in the scale that the fit would take.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, map_coordinates
from scipy.spatial import cKDTree
from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.cores import find_cores
from napari_fiberburst.bundle.samples import only_exposed
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.errors import BundleError
from napari_fiberburst.operators.filters import local_mean

# How far a bundle may have moved.
MOST_SHIFT, MOST_ROTATION = 5.0, 2.0
# Pixels and degrees beyond that are searched, so that a bundle a little too far away is told by how much it has moved.
_MARGIN_SHIFT, _MARGIN_ROTATION = 5.0, 1.0
# In pitches: at the rim of the field, from one angle of the search to the next; and how near its place a core is found.
_ANGLE_STEP, _NEAR = 0.35, 0.25
# Pitches: over this much the slow changes of the frames are divided out.
_ENVELOPE = 3.0
# Light is averaged over so many pitches (standard deviation). A place shows its cores where it has this part of the
# light of the brightest place, or is among the brightest places, this part of all: behind cells on a dark ground, cores
# that are asked further out are not there.
_LIGHT, _LEAST_LIT, _BRIGHTEST = 0.7, 0.3, 0.1
# Part of the light of the brightest surroundings below which nothing is compared.
_DARK = 0.02
# Share of the cores in the frames that must be found in their places. Another bundle has 0.2, the area of the circle
# in which a core counts as found; the same one has over 0.9, and in noise or behind a dark object somewhat less.
_LEAST_FOUND = 0.6
# Correlation of the brightness of cores with that of their neighbours taken out. A bundle with a perfect lattice can
# be confused with another one, or with itself a pitch away, by places alone. Another bundle has up to 0.18.
_LEAST_ALIKE = 0.25
# Cores whose brightness is a guess that differs by less than this part were taken as equal: places alone tell them.
_LEAST_DIFFERENT = 0.1
# A relative change of the distances between cores that is more than a re-plugged probe shows.
_MOST_ZOOM = 0.01
# The same, by how far neighbouring cores are apart: beyond it cores cannot be matched one by one.
_MOST_SPACING = 0.04
# Pixels below which the bundle is where it was.
_LEAST_SHIFT = 0.1
# Fewer cores than this in the frames do not tell one bundle from another.
_LEAST_CORES = 20


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """A bundle where it was found.

    Attributes
    ----------
    bundle : Bundle
        Moved to where the frames show it.
    shift : (float, float)
        Pixels along x and y, of the middle of its frame.
    rotation : float
        Degrees.
    note : str
        What a user should know; empty where the bundle is where it was.
    """

    bundle: Bundle
    shift: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """What frames show of a bundle.

    Attributes
    ----------
    image : numpy.ndarray
        (H, W), the mean of the frames with slow changes divided out.
    lit : numpy.ndarray
        (H, W) bool, where there is light enough to see cores.
    cores : numpy.ndarray
        (N, 2) as (x, y), their centres.
    """

    image: NDArray[np.float32]
    lit: NDArray[np.bool_]
    cores: NDArray[np.float64]


def find_bundle(bundle: Bundle, grey: Tensor, acquisition: Acquisition) -> Placement:
    """Find where frames show a bundle.

    Parameters
    ----------
    bundle : Bundle
        Of the frames' size.
    grey : Tensor
        (T, H, W) in [0, 1].
    acquisition : Acquisition
        Of the burst.

    Raises
    ------
    BundleError
        The frames show another bundle, or this one at another zoom, or too far away.
    """
    if not bundle.is_resolved or len(bundle.centres) < _LEAST_CORES:
        return Placement(bundle)
    mean = only_exposed(grey).mean(dim=0)
    black = bundle.black_in(acquisition)
    flat, lit = (part.cpu() for part in _flattened((mean - black).clamp_min(0), bundle.pitch))
    observed = Observed(image=flat.numpy(), lit=lit.numpy(), cores=find_cores(flat, bundle.pitch, lit))
    if len(observed.cores) < _LEAST_CORES:
        raise BundleError(
            f"the frames show {len(observed.cores)} cores, too few to tell where the bundle is (expected at least "
            f"{_LEAST_CORES}); expose longer, or leave the bundle out"
        )
    best = _refined(np.eye(3), bundle, observed)
    found = _agreement(best, bundle, observed)
    if not _is_it(found):
        best = _refined(_searched(bundle, observed), bundle, observed)
        found = _agreement(best, bundle, observed)
    if not _is_it(found):
        raise BundleError(_otherwise(bundle, observed, found))
    zoom = _zoom(best, bundle, observed)
    if abs(zoom - 1) > _MOST_ZOOM:
        raise BundleError(
            f"the frames show this bundle at {zoom:.3f} times the size it was calibrated at; expected 1 to within "
            f"{_MOST_ZOOM:.0%}; calibrate it again at this zoom"
        )
    return _placed(bundle, best)


def _otherwise(bundle: Bundle, observed: Observed, found: tuple[float, float]) -> str:
    """Return why the frames do not show the bundle."""
    apart = _spacing(observed.cores) / _spacing(bundle.centres)
    if abs(apart - 1) > _MOST_SPACING:
        return (
            f"the frames show another bundle, or this one at another zoom: cores are {apart:.2f} times as far apart as "
            f"the {bundle.pitch:.2f} px of this one; expected 1 to within {_MOST_ZOOM:.0%}; calibrate with the optics "
            "as for the burst, or leave the bundle out"
        )
    return (
        f"the frames show another bundle: {found[0]:.0%} of the cores are where this one has them (expected at least "
        f"{_LEAST_FOUND:.0%}) and their brightness correlates by {found[1]:.2f} (expected {_LEAST_ALIKE}), even if it "
        f"had moved by {MOST_SHIFT:g} px or {MOST_ROTATION:g} degrees; calibrate this bundle, or leave it out"
    )


def _spacing(centres: NDArray[np.float64]) -> float:
    """Return how far neighbouring cores are apart: the median distance to the nearest three."""
    return float(np.median(np.asarray(cKDTree(centres).query(centres, k=4)[0])[:, 1:]))


def _placed(bundle: Bundle, frame_from_bundle: NDArray[np.float64]) -> Placement:
    """Return the bundle moved to where it was found.

    Raises
    ------
    BundleError
        That is too far away.
    """
    height, width = bundle.shape
    middle = np.array([[(width - 1) / 2, (height - 1) / 2]])
    x, y = (transform_points(frame_from_bundle, middle) - middle)[0].tolist()
    rotation = float(np.degrees(np.arctan2(frame_from_bundle[1, 0], frame_from_bundle[0, 0])))
    if np.hypot(x, y) > MOST_SHIFT or abs(rotation) > MOST_ROTATION:
        raise BundleError(
            f"the bundle has moved by {np.hypot(x, y):.1f} px and {abs(rotation):.1f} degrees since it was calibrated; "
            f"expected at most {MOST_SHIFT:g} px and {MOST_ROTATION:g} degrees; calibrate it again"
        )
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], dtype=np.float64)
    farthest = np.linalg.norm(transform_points(frame_from_bundle, corners) - corners, axis=1).max()
    if farthest < _LEAST_SHIFT:
        return Placement(bundle)
    before = np.array(bundle.provenance.get("frame_from_bundle", np.eye(3)), dtype=np.float64)
    moved = bundle.moved(frame_from_bundle).with_frame_from_bundle(frame_from_bundle @ before)
    away = f"{np.hypot(x, y):.1f} px and {abs(rotation):.2f} degrees"
    note = f"the bundle was found {away} away from where it was calibrated"
    return Placement(moved, (x, y), rotation, note)


def _is_it(found: tuple[float, float]) -> bool:
    return found[0] >= _LEAST_FOUND and found[1] >= _LEAST_ALIKE


def _flattened(image: Tensor, pitch: float) -> tuple[Tensor, Tensor]:
    """Return an image (H, W) divided by itself blurred, 0 where there is no light; and where there is light."""
    envelope = local_mean(image, _ENVELOPE * pitch)
    light = local_mean(image, _LIGHT * pitch)
    least = min(_LEAST_LIT * float(light.max()), float(np.quantile(light.cpu().numpy(), 1 - _BRIGHTEST)))
    flat = image / envelope.clamp_min(1e-6)
    return torch.where(envelope > _DARK * envelope.max(), flat, torch.zeros_like(image)), light > least


def _searched(bundle: Bundle, observed: Observed) -> NDArray[np.float64]:
    """Return the rigid motion, of those searched, at which the images correlate best: (3, 3), frame from bundle."""
    expected = _flattened(torch.from_numpy(bundle.transmission), bundle.pitch)[0].numpy()
    height, width = bundle.shape
    step = np.degrees(_ANGLE_STEP * bundle.pitch / (max(height, width) / 2))
    most = MOST_ROTATION + _MARGIN_ROTATION
    angles = np.arange(-np.ceil(most / step), np.ceil(most / step) + 1) * step
    reach = int(np.ceil(MOST_SHIFT + _MARGIN_SHIFT))
    spectrum = np.fft.rfft2(observed.image - observed.image.mean())
    best, score = np.eye(3), -np.inf
    for angle in angles:
        motion = _rigid(np.radians(angle), (0.0, 0.0), (width, height))
        inverse = np.linalg.inv(motion)
        turned = affine_transform(expected, inverse[:2, :2][::-1, ::-1], inverse[:2, 2][::-1], order=1)
        correlation = np.fft.irfft2(spectrum * np.fft.rfft2(turned - turned.mean()).conj(), s=bundle.shape)
        near = np.roll(correlation, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
        row, column = np.unravel_index(int(near.argmax()), near.shape)
        if near.max() > score:
            score = float(near.max())
            best = _rigid(np.radians(angle), (float(column - reach), float(row - reach)), (width, height))
    return best


def _rigid(angle: float, shift: tuple[float, float], size: tuple[int, int]) -> NDArray[np.float64]:
    """Return a rotation about the middle of the frame, and a shift, (3, 3)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = (size[0] - 1) / 2, (size[1] - 1) / 2
    return np.array(
        [
            [cosine, -sine, x - cosine * x + sine * y + shift[0]],
            [sine, cosine, y - sine * x - cosine * y + shift[1]],
            [0, 0, 1],
        ]
    )


def _matches(
    motion: NDArray[np.float64], bundle: Bundle, observed: Observed, reach: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return cores of the bundle and where the frames show them, (M, 2) each, and how many could have been shown.

    A core that looks at a dark part of the object cannot be shown.
    """
    there = transform_points(motion, bundle.centres)
    column, row = np.rint(there).astype(int).clip(0, np.array(bundle.shape[::-1]) - 1).T
    could = ((there >= 1) & (there <= np.array(bundle.shape[::-1]) - 2)).all(axis=1) & observed.lit[row, column]
    distance, number = (np.asarray(part) for part in cKDTree(observed.cores).query(there))
    near = could & (distance < reach)
    return bundle.centres[near], observed.cores[number[near]], int(could.sum())


def _refined(motion: NDArray[np.float64], bundle: Bundle, observed: Observed) -> NDArray[np.float64]:
    """Return the rigid motion that brings the cores to where they are seen (Kabsch, 1976), by shrinking circles."""
    for reach in (0.5, 0.4, 0.3, _NEAR, _NEAR):
        here, there, _ = _matches(motion, bundle, observed, reach * bundle.pitch)
        if len(here) < 8:
            return motion
        first, second = here.mean(axis=0), there.mean(axis=0)
        u, _, v = np.linalg.svd((here - first).T @ (there - second))
        rotation = v.T @ np.diag([1, np.linalg.det(v.T @ u.T)]) @ u.T
        motion = np.eye(3)
        motion[:2, :2], motion[:2, 2] = rotation, second - rotation @ first
    return motion


def _zoom(motion: NDArray[np.float64], bundle: Bundle, observed: Observed) -> float:
    """Return how much larger than calibrated the pattern of matched cores is."""
    here, there, _ = _matches(motion, bundle, observed, _NEAR * bundle.pitch)
    if len(here) < 8:
        return 1.0
    here, there = here - here.mean(axis=0), there - there.mean(axis=0)
    turned = here @ motion[:2, :2].T
    return float((turned * there).sum() / (turned**2).sum())


def _agreement(motion: NDArray[np.float64], bundle: Bundle, observed: Observed) -> tuple[float, float]:
    """Return the share of cores found in their places, and the correlation of their brightness with the bundle's.

    The latter is 1 where the bundle's cores were taken as equally bright, because it then says nothing.
    """
    here, there, count = _matches(motion, bundle, observed, _NEAR * bundle.pitch)
    if len(here) < 8:
        return 0.0, 0.0
    brightness = bundle.brightness
    if not bundle.gains_known and brightness.std() < _LEAST_DIFFERENT * brightness.mean():
        return len(here) / max(count, 1), 1.0
    flat = _flattened(torch.from_numpy(bundle.transmission), bundle.pitch)[0].numpy()
    known, shown = (
        map_coordinates(image, points.T[::-1], order=1) for image, points in ((flat, here), (observed.image, there))
    )
    near = np.asarray(cKDTree(here).query(here, k=7)[1])
    known, shown = (values - values[near[:, 1:]].mean(axis=1) for values in (known, shown))
    power = float(np.sqrt((known**2).sum() * (shown**2).sum()))
    return len(here) / max(count, 1), float((known * shown).sum()) / power if power > 0 else 0.0

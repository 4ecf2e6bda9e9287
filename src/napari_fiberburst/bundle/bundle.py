"""What is known of a fibre bundle: measured once, kept in a file, used for every burst through the same probe."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import affine_transform
from scipy.spatial import cKDTree

from napari_fiberburst.bundle.lattice import REACH, nearest_core
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.data.burst import Acquisition, Burst
from napari_fiberburst.errors import BundleError, FiberBurstError
from napari_fiberburst.stored import Stored

# A core whose gain is known better than a bright core seen this often at full light counts no more than this: a probe
# ages, and what was measured long ago must be able to give way.
_MOST_GAIN_WEIGHT = 1000.0
# In pitches: two cores that are closer than this are the same one; and the share of cores that must be.
_SAME_CORE, _LEAST_SAME = 0.3, 0.7
# Variance of gains about those of a bundle: bundles measured have 15 to 20 % (1 sigma) about the mean frame, and gains
# that were measured before come back within some per cent.
GUESSED_GAINS, MEASURED_GAINS = 0.04, 0.03**2

Pattern = Literal["cores", "unresolved", "none"]
# One image or several, or the files that they are in.
Images = ArrayLike | str | Path | Sequence[str | Path]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bundle(Stored):
    """A fibre bundle as a camera sees it.

    Arrays are read-only in spirit: a bundle is a value, and every method returns a new one. Intensities are in the
    recording's own units, so a bundle serves bursts with other black and white levels.

    Attributes
    ----------
    pattern : str
        "cores" where the cores can be told apart; "unresolved" where the image shows a bundle whose cores are too
        close for its pixels; "none" where it shows no bundle. In the last two, square blocks of pixels stand for cores.
    pitch : float
        Distance of neighbouring cores, or the side of the blocks, pixels.
    radius : float
        Of a core's footprint, the area over which it gathers light, pixels.
    centres : numpy.ndarray
        (N, 2) float64 as (x, y), frame pixels.
    labels : numpy.ndarray
        (H, W) int32, the core that each pixel shows; N where none.
    transmission : numpy.ndarray
        (H, W) float32, the part of the light that each pixel passes: 1 where a bright core is brightest, 0 outside the
        cores.
    gains : numpy.ndarray
        (N, C) float32, each core's gain in each channel relative to its transmission, about 1; C is 1 where all
        channels are alike.
    gain_weights : numpy.ndarray
        (N,) float32, how well each core's gain is known: the number of times it was measured at the full light of a
        bright core, or the equivalent of it in dimmer light. 0 where it is only a guess, from the mean of frames.
    offsets : numpy.ndarray
        (N, C) float32, the light that each core shows without any object, as amplitude of its profile, intensity
        units: fluorescence of the fibre, for example. C as for `gains`, or 1.
    black : float
        Intensity without any light.
    dead : numpy.ndarray
        (M, 2) float64 as (x, y), places in the lattice without light.
    saturated : numpy.ndarray
        (N,) bool, cores too bright for the camera when the bundle was measured.
    outline : numpy.ndarray
        (H, W) bool, the field: where the bundle is.
    provenance : mapping
        Where the bundle comes from, as plain values: "source" ("burst" or "image"), "frames" (how many), "files" and
        "dark" (names of the images, where they came from files), "date", "version" (of this package), "bursts" (how
        many it has been improved by), and "frame_from_bundle" in a reconstruction whose frames show the bundle
        elsewhere than where it was calibrated.

    See Also
    --------
    napari_fiberburst.reconstruct : takes a bundle, so that one single frame can be reconstructed.
    """

    _kind: ClassVar[str] = "bundle"
    _ending: ClassVar[str] = ".bundle"
    _error: ClassVar[type[FiberBurstError]] = BundleError

    pattern: Pattern
    pitch: float
    radius: float
    centres: NDArray[np.float64]
    labels: NDArray[np.int32]
    transmission: NDArray[np.float32]
    gains: NDArray[np.float32]
    gain_weights: NDArray[np.float32]
    offsets: NDArray[np.float32]
    black: float
    dead: NDArray[np.float64]
    saturated: NDArray[np.bool_]
    outline: NDArray[np.bool_]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        height, width = self.shape
        cores = {"cores": f"{len(self.centres)} cores, {self.pitch:.2f} px apart"}.get(self.pattern, self.pattern)
        return f"Bundle({height} x {width}, {cores})"

    @staticmethod
    def is_file(path: str | Path) -> bool:
        """Whether a path names a bundle that was saved, by its ending."""
        return str(path).lower().endswith(Bundle._ending)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the frames that show the bundle."""
        height, width = self.transmission.shape
        return height, width

    @property
    def is_resolved(self) -> bool:
        """Whether the cores can be told apart."""
        return self.pattern == "cores"

    @property
    def gains_known(self) -> bool:
        """Whether a burst need not be asked for the gains: they have been measured, or there is no bundle."""
        return self.pattern == "none" or bool((self.gain_weights > 0).any())

    @property
    def gain_variance(self) -> float:
        """How far a burst may find gains from those of the bundle, as a relative variance; 0 where there is none."""
        if self.pattern == "none":
            return 0.0
        return MEASURED_GAINS if self.gains_known else GUESSED_GAINS

    def black_in(self, acquisition: Acquisition) -> float:
        """Return the black level in the intensities of a burst, full scale 1."""
        return (self.black - acquisition.black_level) / (acquisition.white_level - acquisition.black_level)

    @property
    def brightness(self) -> NDArray[np.float64]:
        """How much light each core passes, as a part of a bright core's, (N,)."""
        own = self.labels < len(self.centres)
        labels, passed = self.labels[own], self.transmission[own].astype(np.float64)
        power, mass = (np.bincount(labels, passed**order, len(self.centres)) for order in (2, 1))
        bright: NDArray[np.float64] = power / np.maximum(mass, 1e-9)
        return bright

    @classmethod
    def from_burst(cls, burst: Burst, *, device: str = "auto") -> "Bundle":
        """Calibrate a bundle from the mean of a burst's frames.

        What the mean still shows of the object is taken for gain. Where the object moves,
        ``reconstruct(burst).bundle`` knows the gains better, because it has told bundle and object apart.

        Parameters
        ----------
        burst : Burst
            Frames of a moving object.
        device : str
            Where to compute.

        Raises
        ------
        BundleError
            The frames show no bundle.
        """
        from napari_fiberburst.bundle.calibrate import calibrate  # it makes bundles, so it imports this module

        bundle = calibrate(burst, device=device)
        if bundle.pattern == "none":
            raise BundleError(
                f"no bundle is seen in the mean of these {burst.shape[0]} frames; expected a pattern of cores 2.3 to "
                "24 px apart; calibrate from frames of a moving object, or from an image in even light"
            )
        return bundle

    @classmethod
    def from_image(cls, image: "Images", *, dark: "Images | None" = None, device: str = "auto") -> "Bundle":
        """Calibrate a bundle from an image of it with nothing but even light before it.

        Parameters
        ----------
        image : array_like, path or sequence of paths
            (H, W) or (H, W, C), intensities as the camera gives them; several, (T, H, W) or (T, H, W, C), are averaged,
            which leaves less of the camera's noise in the gains. Colour gives each core's gain in each channel.
        dark : array_like, path or sequence of paths, optional
            The same without light, or with all the light that does not come from the object: its darkest part is the
            black level, and what each core shows above it that core's offset. Without, the darkest part of `image`
            is the black level.
        device : str
            Where to compute.

        Raises
        ------
        BundleError
            An image cannot be read, has another size than the other one, is black or saturated; the dark one is
            brighter than the other; no bundle is seen.
        """
        from napari_fiberburst.bundle.flat import calibrate_flat  # it makes bundles, so it imports this module

        return calibrate_flat(image, dark, device=device)

    def crop(self, rows: tuple[int, int], columns: tuple[int, int]) -> Self:
        """Return the part [y0, y1) x [x0, x1) of the bundle, for bursts that were cropped alike.

        Cores whose centre lies outside stay where their light is seen.

        Raises
        ------
        BundleError
            The crop is empty or leaves the frame, or there is no core in it.
        """
        for axis, (start, stop), size in zip("yx", (rows, columns), self.shape, strict=True):
            if not 0 <= start < stop <= size:
                raise BundleError(
                    f"a crop must lie inside the bundle's frame, {axis} within 0:{size}; got {start}:{stop}"
                )
        part = (slice(*rows), slice(*columns))
        labels = self.labels[part]
        kept = np.unique(labels[labels < len(self.centres)])
        if not len(kept):
            raise BundleError(f"no core lies in rows {rows[0]}:{rows[1]}, columns {columns[0]}:{columns[1]}; crop less")
        renumbered = np.full(len(self.centres) + 1, len(kept), dtype=np.int32)
        renumbered[kept] = np.arange(len(kept))
        first = np.array([columns[0], rows[0]], dtype=np.float64)
        dead = self.dead - first
        inside = ((dead >= -0.5) & (dead < np.array(labels.shape[::-1]) - 0.5)).all(axis=1)
        return replace(
            self,
            centres=self.centres[kept] - first,
            labels=renumbered[labels],
            transmission=np.ascontiguousarray(self.transmission[part]),
            gains=self.gains[kept],
            gain_weights=self.gain_weights[kept],
            offsets=self.offsets[kept],
            saturated=self.saturated[kept],
            dead=dead[inside],
            outline=np.ascontiguousarray(self.outline[part]),
        )

    def masked(self, hidden: NDArray[np.bool_]) -> Self:
        """Return the bundle without those pixels that are hidden, (H, W) bool; cores stay with what is left of them."""
        return replace(
            self,
            labels=np.where(hidden, np.int32(len(self.centres)), self.labels),
            transmission=np.where(hidden, np.float32(0), self.transmission),
        )

    def moved(self, frame_from_bundle: NDArray[np.float64]) -> Self:
        """Return the bundle as the camera sees it after it has moved.

        Parameters
        ----------
        frame_from_bundle : numpy.ndarray
            (3, 3), a rigid motion: pixel (x, y) of this bundle to the pixel where it is now.

        Notes
        -----
        The transmission is interpolated by cubic splines. What comes in from beyond the frame passes no light.
        """
        bundle_from_frame = np.linalg.inv(frame_from_bundle)
        linear, shift = bundle_from_frame[:2, :2][::-1, ::-1], bundle_from_frame[:2, 2][::-1]
        centres = transform_points(frame_from_bundle, self.centres)
        transmission = affine_transform(self.transmission, linear, shift, order=3)
        outline = affine_transform(self.outline.astype(np.float32), linear, shift, order=1) > 0.5
        labels = nearest_core(centres, outline, REACH * self.pitch).astype(np.int32)
        own = labels < len(centres)
        return replace(
            self,
            centres=centres,
            labels=labels,
            transmission=np.where(own, transmission, 0).clip(0).astype(np.float32),
            dead=transform_points(frame_from_bundle, self.dead),
            outline=outline,
        )

    def updated(self, measured: "GainMeasurement") -> Self:
        """Return the bundle with its gains improved by a burst that was reconstructed with it.

        Every gain becomes the mean of what is known and what the burst has measured, each weighed by how much light
        it rests on. Their common factor, which no burst can tell from the brightness of the object, stays.

        Parameters
        ----------
        measured : Reconstruction, Mosaic or Video
            Of frames through this bundle, such as ``reconstruct(frames, bundle=bundle)``. They may have been cropped,
            and the bundle may have moved.

        Raises
        ------
        BundleError
            The reconstruction was not made behind a bundle, or its bundle is another one.

        Examples
        --------
        >>> from napari_fiberburst import Bundle, reconstruct
        >>> from napari_fiberburst.simulation import simulate
        >>> probe = {"shape": (64, 72), "frames": 6, "pitch": 5.0, "physics": "core", "seed": 0}
        >>> first, second = simulate("cat", **probe), simulate("histology", **probe)
        >>> bundle = reconstruct(first.burst).bundle
        >>> better = bundle.updated(reconstruct(second.burst, bundle=bundle))
        >>> bool((better.gain_weights >= bundle.gain_weights).all())
        True
        """
        there = measured.bundle
        if there is None or measured.gain_ratios is None or measured.gain_weights is None:
            raise BundleError("the reconstruction has measured no gains; reconstruct a burst with this bundle")
        placed = self._placed_as(there)
        distance, match = _nearest(there.centres, placed.centres)
        inside = ((placed.centres >= 0) & (placed.centres <= np.array(there.shape[::-1]) - 1)).all(axis=1)
        same = distance < _SAME_CORE * self.pitch
        if not inside.any() or same[inside].mean() < _LEAST_SAME:
            share = same[inside].mean() if inside.any() else 0.0
            raise BundleError(
                f"the reconstruction is of another bundle: {share:.0%} of the cores lie where this one has them "
                f"(expected at least {_LEAST_SAME:.0%}); give a result of reconstruct(..., bundle=...) with this bundle"
            )
        ratio = np.ones(len(match))
        weight = np.zeros(len(match))
        bright, brightness = placed.brightness, there.brightness
        known = same & (bright > 0)
        ratio[known] = brightness[match[known]] * measured.gain_ratios[match[known]] / bright[known]
        weight[known] = measured.gain_weights[match[known]]
        usable = known & (weight > 0) & (ratio > 0)
        if usable.any():
            ratio[usable] /= np.median(ratio[usable])
        weight[~usable], ratio[~usable] = 0, 1
        total = self.gain_weights + weight
        change = np.where(total > 0, (self.gain_weights + weight * ratio) / np.maximum(total, 1e-12), 1.0)
        per_pixel = np.append(change, 1.0)[self.labels]
        return replace(
            self,
            transmission=(self.transmission * per_pixel).astype(np.float32),
            gain_weights=np.minimum(total, _MOST_GAIN_WEIGHT).astype(np.float32),
            offsets=(self.offsets / np.maximum(change, 1e-2)[:, None]).astype(np.float32),
            provenance={**self.provenance, "bursts": int(self.provenance.get("bursts", 0)) + 1},
        )

    def fitted_to(self, acquisition: Acquisition) -> Self:
        """Return the bundle for frames of this size: itself, or the part of it that the frames were cropped from.

        Raises
        ------
        BundleError
            Neither fits.
        """
        height, width = acquisition.shape[1:3]
        if self.shape == (height, width):
            return self.with_frame_from_bundle(np.eye(3))
        row, column = acquisition.origin
        if row + height <= self.shape[0] and column + width <= self.shape[1] and (row, column) != (0, 0):
            part = self.crop((row, row + height), (column, column + width))
            return part.with_frame_from_bundle(np.array([[1.0, 0, -column], [0, 1, -row], [0, 0, 1]]))
        raise BundleError(
            f"the bundle was measured in frames of {self.shape[0]} x {self.shape[1]} pixels, and the burst has "
            f"{height} x {width}; calibrate with the camera set as for the burst, or crop both alike (Bundle.crop)"
        )

    def with_frame_from_bundle(self, frame_from_bundle: NDArray[np.float64]) -> Self:
        """Return the bundle with a note of the motion (3, 3) that has brought it to where it is, for `updated`."""
        told = {name: value for name, value in self.provenance.items() if name != "frame_from_bundle"}
        if not np.array_equal(frame_from_bundle, np.eye(3)):
            told["frame_from_bundle"] = np.asarray(frame_from_bundle).tolist()
        return self if told == self.provenance else replace(self, provenance=told)

    def _placed_as(self, there: "Bundle") -> Self:
        """Return this bundle in the frames of another one that was made from it by `fitted_to` and `moved`.

        What interpolation does to the brightness of cores is the same in both, so it is not taken for gain; neither is
        that a mark hides a part of a core in the other.
        """
        if "frame_from_bundle" not in there.provenance:
            return self
        placed = self.moved(np.array(there.provenance["frame_from_bundle"], dtype=np.float64))
        part = (slice(there.shape[0]), slice(there.shape[1]))
        placed = replace(placed, transmission=placed.transmission[part], labels=placed.labels[part])
        return placed.masked(there.labels == len(there.centres))

    def to_image(self) -> NDArray[np.uint8]:
        """Return the bundle as an image, (H, W, 3): transmission in grey, saturated cores red, dead ones blue."""
        bright = np.quantile(self.transmission[self.outline], 0.99) if self.outline.any() else 1.0
        grey = np.clip(self.transmission / max(float(bright), 1e-6), 0, 1)
        shown = np.repeat(grey[..., None], 3, axis=2)
        too_bright = np.append(self.saturated, False)[self.labels]
        shown[too_bright, 1:] *= 0.3
        y, x = np.indices(self.shape)
        for cx, cy in self.dead:
            shown[np.hypot(x - cx, y - cy) < 0.4 * self.pitch] = (0.2, 0.4, 1.0)
        drawn: NDArray[np.uint8] = np.rint(255 * shown).astype(np.uint8)
        return drawn

    def _check(self) -> None:
        """Refuse contents that do not belong together."""
        for name in ("centres", "transmission", "gains", "offsets", "dead"):
            if getattr(self, name).ndim != 2 or 0 in getattr(self, name).shape[1:]:
                raise ValueError(f"{name} is of shape {getattr(self, name).shape}, expected two axes")
        count, shape = len(self.centres), self.transmission.shape
        expected: dict[str, tuple[str, tuple[int, ...]]] = {
            "centres": ("float64", (count, 2)),
            "labels": ("int32", shape),
            "transmission": ("float32", shape),
            "gains": ("float32", (count, self.gains.shape[1])),
            "gain_weights": ("float32", (count,)),
            "offsets": ("float32", (count, self.offsets.shape[1])),
            "dead": ("float64", (len(self.dead), 2)),
            "saturated": ("bool", (count,)),
            "outline": ("bool", shape),
        }
        for name, (dtype, wanted) in expected.items():
            array = getattr(self, name)
            if array.dtype != dtype or array.shape != wanted:
                raise ValueError(f"{name} is {array.dtype} of shape {array.shape}, expected {dtype} of {wanted}")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise ValueError(f"{name} holds NaN or infinity")
        if not count or not (0 <= self.labels.min() and self.labels.max() <= count):
            raise ValueError(f"labels must lie in 0 to {count}, and there must be a core")
        if not (self.gains > 0).all() or not (self.gain_weights >= 0).all():
            raise ValueError("gains must be positive, and their weights not negative")
        if self.pattern not in get_args(Pattern):
            raise ValueError(f"pattern must be one of {', '.join(get_args(Pattern))}; got {self.pattern!r}")
        if not (0 < self.pitch < np.inf and 0 < self.radius < np.inf and np.isfinite(self.black)):
            raise ValueError("pitch and radius must be positive and finite, and black finite")
        if not isinstance(self.provenance, Mapping):
            raise TypeError("provenance must be a mapping")


class GainMeasurement(Protocol):
    """What frames tell of a bundle: a `Reconstruction`, or a mosaic or a video of a recording."""

    @property
    def bundle(self) -> Bundle | None:
        """The bundle that the frames were sampled with."""

    @property
    def gain_ratios(self) -> NDArray[np.float32] | None:
        """Each core's gain as the frames show it, relative to the bundle's, (N,)."""

    @property
    def gain_weights(self) -> NDArray[np.float32] | None:
        """How much light that rests on, (N,)."""


def _nearest(points: NDArray[np.float64], asked: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return distance and number of the point nearest to each one that is asked for."""
    distance, number = cKDTree(points).query(asked)
    return np.asarray(distance, dtype=np.float64), np.asarray(number, dtype=np.intp)

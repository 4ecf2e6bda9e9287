"""One bundle at one bit depth: what is made once of it, and the scene behind it as it stands."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.errors import BurstError
from napari_fiberburst.live.cores import Cores
from napari_fiberburst.live.finding import Finder
from napari_fiberburst.live.fitting import Fit, Fitter
from napari_fiberburst.live.forgetting import Forgetting
from napari_fiberburst.live.levels import Levels
from napari_fiberburst.live.memory import Memory
from napari_fiberburst.live.pose import Pose
from napari_fiberburst.live.sampling import CoreLight, CoreSampler
from napari_fiberburst.live.sharpening import Sharpener
from napari_fiberburst.live.smear import Smear
from napari_fiberburst.live.view import Advice, LiveView, State

# Steps of conjugate gradients for the first frame of a scene, and for each later one.
_FIRST_STEPS, _STEPS = 30, 4
# A frame belongs to the scene where it is this much like it. After so many frames that are not, a new one begins.
_LEAST_ALIKE, _PATIENCE = 0.6, 2
# One that is darker than this part of the scene's light shows something else.
_LEAST_BRIGHTNESS = 0.02
# Contact is lost where cores differ by less than this part of what they usually do, relative to full scale.
_LEAST_CONTRAST, _FAINT = 0.35, 1e-3
# Part of the cores that may be saturated, or unreadable.
_MOST_GLARE, _MOST_UNREADABLE = 0.05, 0.5
# A step of more than this part of the field's shorter side is too fast.
_MOST_STEP = 0.2
# Part of the field that has been looked at where there is no need to move.
_ENOUGH_COVERED, _SEEN = 0.7, 0.02
# With less of the field looked at, frames are fitted to the scene blurred by this Gaussian, pitches.
_FEW_COVERED, _SOFT = 0.8, 0.6
# Farther than so many pitches from a core nothing is drawn.
_REACH = 1.0
# After a turn or a zoom that moves corners by more than so many pixels the scene lies upright in the newest frame.
_MOST_TURN = 6.0


class Probe:
    """One bundle at one bit depth: all that is made once, and the scene.

    Parameters
    ----------
    bundle : Bundle
        Of the frames' size.
    pixels : numpy.ndarray
        (H, W) or (H, W, C), the first frame.
    levels : Levels
        Of the frames.
    half_life : float or None
        After so many frames one counts half as much; None lets it follow what is seen.
    piece : int
        How many scenes there were before.

    Attributes
    ----------
    piece : int
        How many times the scene was begun anew.
    light : numpy.ndarray
        (N,), what the cores show in the newest frame.
    """

    def __init__(
        self, bundle: Bundle, pixels: NDArray[Any], levels: Levels, half_life: float | None, piece: int = 0
    ) -> None:
        if bundle.shape != pixels.shape[:2]:
            raise BurstError(
                f"the bundle was measured in frames of {bundle.shape[0]} x {bundle.shape[1]} pixels, and the camera "
                f"gives {pixels.shape[0]} x {pixels.shape[1]}; set it as for the bundle, or leave the bundle out"
            )
        self.dtype = pixels.dtype
        self._levels = levels
        self._shape = bundle.shape
        self.see_through(bundle)
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        area = float(max(1, bundle.outline.sum()))
        self._memory = Memory(self._shape, bundle.pitch, bundle.radius, area, channels)
        self._sharpener = Sharpener(self._memory, bundle.radius)
        self._pose = Pose.at_rest(self._shape)
        self._base = np.eye(3)
        self._smear = Smear(bundle.pitch)
        self._half_life = half_life
        self._spectrum: NDArray[np.complex64] | None = None
        self._usual_contrast, self._brightness = 0.0, 1.0
        self._missed, self.piece, self._seen_part = 0, piece, 0.0
        self._image = np.full((*self._shape, channels), np.nan, np.float32)
        self._is_grey = pixels.ndim == 2
        self.light = np.zeros(len(bundle.centres), np.float32)

    def see_through(self, bundle: Bundle) -> None:
        """Take the places of the cores, and all else that frames are seen by, from a bundle."""
        self._bundle = bundle
        self._sampler = CoreSampler(bundle, self._levels)
        self._cores = Cores.of(bundle.centres, self._shape)
        self._fitter = Fitter(self._cores)
        self._finder = Finder(bundle.centres, self._shape, bundle.pitch)
        self._forgetting = Forgetting(bundle.centres, self._shape, bundle.pitch, bundle.radius)
        self._ground = np.where(_near_cores(bundle), np.float32(bundle.black), np.float32(np.nan))

    @property
    def _remembers(self) -> float:
        """Frames after which one counts half as much."""
        return self._forgetting.half_life if self._half_life is None else self._half_life

    def push(self, pixels: NDArray[Any]) -> LiveView:
        """Take in a frame and return the picture."""
        light = self._sampler(pixels.reshape(*self._shape, -1))
        grey = self.light = light.grey
        if light.glare > _MOST_GLARE:
            return self._missing("too bright")
        contrast = float(grey[light.weights > 0].std()) if (light.weights > 0).any() else 0.0
        if light.unreadable > _MOST_UNREADABLE or contrast < max(_FAINT, 0.1 * self._usual_contrast):
            return self._missing("out of contact")
        spectrum = self._finder.spectrum(grey, light.weights)
        if self._spectrum is None:
            return self._begun(light, spectrum, contrast)
        found, shift = self._found(light, grey, spectrum)
        if not (found.alike >= _LEAST_ALIKE and found.brightness >= _LEAST_BRIGHTNESS):  # NaN is not
            if contrast < _LEAST_CONTRAST * self._usual_contrast:
                return self._missing("out of contact")
            self._missed += 1
            if self._missed < _PATIENCE:
                return self._view("lost", "too fast", found.alike)
            self.piece += 1
            return self._begun(light, spectrum, contrast)
        shown, scene = grey / np.float32(found.brightness), self._scene()
        step = found.pose.place - self._pose.place
        self._smear.take(step, self._cores, found.pose, shown, light.weights, scene, self._memory)
        if self._half_life is None:
            self._forgetting.take(found.pose, shown, light.weights, scene, self._memory)
        self._base_on(found.pose)
        self._missed, self._spectrum = 0, spectrum
        self._usual_contrast += 0.1 * (contrast - self._usual_contrast)
        self._brightness = found.brightness
        self._add(light, is_new=False)
        self._seen_part = covered = self._covered()
        return self._view("following", self._advised(abs(shift), covered), found.alike, abs(shift), covered)

    def follow_levels(self, pixels: NDArray[Any]) -> None:
        """Raise the white level where a frame is above it: the first ones may have been dim."""
        highest = float(pixels.max())
        if not highest > self._levels.white:
            return
        before = self._levels
        # Floats do not tell full scale, so there is room for the next ones.
        white = 2 * highest if pixels.dtype.kind == "f" else Levels.of(pixels, before.black, None).white
        self._levels = Levels(before.black, white)
        self._sampler = CoreSampler(self._bundle, self._levels)
        # All that is known is in parts of full scale.
        scale = before.span / self._levels.span
        self._brightness *= scale
        self._usual_contrast *= scale

    def begin_anew(self) -> None:
        """Begin a new scene with the next frame."""
        self._spectrum = None
        self.piece += 1

    def forget(self, kept: float) -> None:
        """Keep this part of the weight of what was seen: it was seen by what has turned out to be wrong."""
        self._memory.forget(kept)

    def _found(
        self, light: CoreLight, grey: NDArray[np.float32], spectrum: NDArray[np.complex64]
    ) -> tuple[Fit, complex]:
        """Return how a frame lies on the scene, and how far from the one before."""
        assert self._spectrum is not None
        shift = self._finder.shift(self._spectrum, spectrum)
        memory = self._memory
        scene = self._scene()
        is_young = self._seen_part < _FEW_COVERED
        if is_young:
            # What lies between few cores is drawn from them, and would hold the next frame where it draws them.
            scene = gaussian_filter(scene, _SOFT * self._bundle.pitch / memory.nodes.spacing)
        start = self._pose.moved(shift * self._pose.turn)
        found = self._fitter(grey, light.weights, scene, memory, start, turns=not is_young)
        return found, found.pose.place - self._pose.place

    def _scene(self) -> NDArray[np.float32]:
        """Return the mean of the scene's channels, (rows, columns)."""
        scene = self._memory.scene
        grey: NDArray[np.float32] = scene[0] if len(scene) == 1 else scene.mean(axis=0)
        return grey

    def _begun(self, light: CoreLight, spectrum: NDArray[np.complex64], contrast: float) -> LiveView:
        """Begin a new scene with a frame."""
        self._memory.clear(light.values.shape[1])
        self._pose, self._base = Pose.at_rest(self._shape), np.eye(3)
        self._missed, self._spectrum, self._brightness = 0, spectrum, 1.0
        self._smear = Smear(self._bundle.pitch)
        self._forgetting.begin_anew()
        self._usual_contrast, self._seen_part = contrast, 0.0
        self._add(light, is_new=True)
        return self._view("following", "move a little", 1.0, 0.0, self._covered())

    def _base_on(self, pose: Pose) -> None:
        """Take a pose; where it has turned far, let the scene lie upright in this frame."""
        if pose.corner_motion() > _MOST_TURN:
            self._memory.turn_to(pose)
            self._forgetting.turn_to(pose)
            self._base = self._base @ pose.matrix
            pose = Pose.at_rest(self._shape)
        self._pose = pose

    def _add(self, light: CoreLight, *, is_new: bool) -> None:
        memory, height, width = self._memory, *self._shape
        corner = self._pose.place - self._pose.middle
        memory.centre_on(corner, corner + complex(width - 1, height - 1))
        if not is_new:
            memory.forget(0.5 ** (1 / self._remembers))
        brightness = np.float32(self._brightness)
        memory.add(self._cores, self._pose, light.values / brightness, light.weights * brightness**2)
        if is_new:
            memory.start(0.5 * self._bundle.pitch)
        memory.solve(_FIRST_STEPS if is_new else _STEPS)
        self._image = self._sharpener(memory, self._pose, self._brightness * self._levels.span, self._ground)

    def _covered(self) -> float:
        """Return which part of the middle of the field has been looked at."""
        rows, columns = self._memory.nodes.rows, self._memory.nodes.columns
        middle = self._memory.seen[rows // 4 : 3 * rows // 4 : 2, columns // 4 : 3 * columns // 4 : 2]
        return float((middle > _SEEN * self._memory.growth).mean())

    def _advised(self, step: float, covered: float) -> Advice:
        if step > _MOST_STEP * min(self._shape):
            return "too fast"
        if self._smear.is_told:
            return "hold still"
        return "fine" if covered > _ENOUGH_COVERED else "move a little"

    def _missing(self, advice: Advice) -> LiveView:
        return self._view("lost", advice)

    def _view(
        self, state: State, advice: Advice, alike: float = 0.0, speed: float = 0.0, covered: float = 0.0
    ) -> LiveView:
        return LiveView(
            image=self._image[..., 0] if self._is_grey else self._image,
            homography=self._base @ self._pose.matrix,
            state=state,
            advice=advice,
            piece=self.piece,
            alike=alike,
            brightness=self._brightness,
            speed=speed,
            covered=covered,
            half_life=self._remembers,
        )


def _near_cores(bundle: Bundle) -> NDArray[np.bool_]:
    """Return the pixels that have a core within reach, (H, W)."""
    reach, centres = _REACH * bundle.pitch, bundle.centres
    y, x = (part.ravel() for part in np.indices(bundle.shape))
    # Nearly all pixels are near the core that they show; to look for the others' is slow.
    labels = bundle.labels.ravel()
    shown = np.append(centres, [[np.inf, np.inf]], axis=0)[labels]
    near: NDArray[np.bool_] = (shown[:, 0] - x) ** 2 + (shown[:, 1] - y) ** 2 <= reach**2
    others = np.flatnonzero(~near)
    pixels = np.stack([x[others], y[others]], axis=1)
    near[others] = np.isfinite(cKDTree(centres).query(pixels, distance_upper_bound=reach)[0])
    return near.reshape(bundle.shape)

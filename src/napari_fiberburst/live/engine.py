"""LiveEngine: a picture for every frame, sharper with each."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.burst import MIN_SIDE
from napari_fiberburst.errors import BurstError
from napari_fiberburst.live.calibration import Calibration
from napari_fiberburst.live.honeycomb import Honeycomb
from napari_fiberburst.live.improving import Improving
from napari_fiberburst.live.levels import Levels
from napari_fiberburst.live.view import Advice, LiveView, State

if TYPE_CHECKING:
    from napari_fiberburst.live.probe import Probe

# Part of the weight that is left of a scene that was seen with gains that were far off.
_KEPT = 0.05


class LiveEngine:
    """Makes a picture for every frame, of that frame and those before it.

    Parameters
    ----------
    bundle : Bundle, optional
        Of the frames. Without, the engine calibrates itself from the first twenty frames that differ, spread over a
        second at least where their times are given, in a thread of its own, while it goes on taking frames.
    half_life : float, optional
        Frames after which half of what was seen is forgotten. By default 4 to 20, by how fast what is seen changes.
    black_level, white_level : float, optional
        Intensities without light and at full scale; by default as `Burst` takes them from the first frame.
    improves : bool
        Whether the gains of the bundle are measured on, beside the frames, as more and more of them come.
    waits : bool
        Whether the frame that completes a calibration, or the frames for better gains, waits for it. What comes of
        frames then does not depend on how fast the machine is.

    Raises
    ------
    BurstError
        The half-life is not positive.

    Attributes
    ----------
    bundle : Bundle or None
        As it is known by now.

    Notes
    -----
    An engine is closed by `close`, or at the end of a ``with`` block; otherwise its thread ends soon after the engine
    is no longer used.

    Examples
    --------
    >>> from napari_fiberburst.simulation import simulate_recording
    >>> recording = simulate_recording(frames=24, shape=(97, 121), pitch=6.0, path="handheld", step=1.5)
    >>> with LiveEngine(waits=True) as engine:
    ...     views = [engine.push(frame) for frame in recording.source.recorded(range(24))]
    >>> views[0].state, views[-1].state, views[-1].image.shape
    ('calibrating', 'following', (97, 121, 1))
    """

    def __init__(
        self,
        bundle: Bundle | None = None,
        *,
        half_life: float | None = None,
        black_level: float | None = None,
        white_level: float | None = None,
        improves: bool = True,
        waits: bool = False,
    ) -> None:
        if half_life is not None and not 0 < half_life < np.inf:
            raise BurstError(f"the half-life must be a positive number of frames; got {half_life}")
        from napari_fiberburst.live.probe import Probe  # compiles its loops, once for an installation, or loads them

        self._begin = Probe
        self.bundle = bundle
        self._half_life = half_life
        self._asked_levels = black_level, white_level
        self._calibration = Calibration(black_level, white_level, waits=waits)
        self._improving = Improving(black_level, white_level, waits=waits) if improves else None
        self._is_closed = False
        self._probe: Probe | None = None
        self._last: NDArray[Any] | None = None
        self._honeycomb: Honeycomb | None = None
        self._view: LiveView | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End what goes on beside the frames, and return when it has ended; the engine takes no more of them."""
        self._is_closed = True
        self._calibration.close()
        if self._improving is not None:
            self._improving.close()

    def push(self, frame: ArrayLike, seconds: float | None = None) -> LiveView:
        """Take in the newest frame and return the picture.

        Parameters
        ----------
        frame : array_like
            (H, W) or (H, W, C), integers or floats.
        seconds : float, optional
            When it was taken, on any clock.

        Raises
        ------
        BurstError
            It is no frame, or not of the size of the ones before or of the bundle; or its time is not finite. What was
            seen before stays, and the next frame that fits goes on. Or the engine was closed.
        """
        if self._is_closed:
            raise BurstError("this live engine was closed and takes no more frames; begin a new one")
        pixels = _checked(frame)
        if seconds is not None and not math.isfinite(seconds):
            raise BurstError(f"the time of a live frame must be finite, in seconds; got {seconds}: leave it out")
        if self._last is not None and pixels.shape != self._last.shape:
            raise BurstError(
                f"frames were {_size(self._last)}, but this one is {_size(pixels)}; set the camera back, or begin a "
                "new live view"
            )
        if self._last is not None and np.array_equal(pixels, self._last):
            return self._told("frozen", "the camera has stopped", pixels, seconds)
        if self.bundle is None:
            self.bundle = self._calibration.take(pixels, seconds)
        if self.bundle is None:
            self._last = pixels
            return self._told("calibrating", "wait", pixels, seconds)
        self._probe = probe = self._probe_for(self.bundle, pixels)
        self._last = pixels
        view = self._with_bundle_watched(probe, pixels, replace(probe.push(pixels), seconds=seconds))
        self._view = view
        if view.state == "following":
            self._improve(probe, pixels)
        return view

    def _probe_for(self, bundle: Bundle, pixels: NDArray[Any]) -> "Probe":
        """Return what frames like this one are seen with."""
        before = self._probe
        if before is None:
            return self._begin(bundle, pixels, Levels.of(pixels, *self._asked_levels), self._half_life)
        if before.dtype != pixels.dtype:
            # Levels are others, and so are frames that were kept.
            if self._improving is not None:
                self._improving.forget()
            return self._begin(
                bundle, pixels, Levels.of(pixels, *self._asked_levels), self._half_life, before.piece + 1
            )
        if self._asked_levels[1] is None:
            before.follow_levels(pixels)
        return before

    def _with_bundle_watched(self, probe: "Probe", pixels: NDArray[Any], view: LiveView) -> LiveView:
        """Return a view that tells where frames show another bundle, and follow this one where it has moved."""
        if self.bundle is None or not self.bundle.is_resolved or view.advice in ("out of contact", "too bright"):
            return view
        if self._honeycomb is None:
            self._honeycomb = Honeycomb(self.bundle)
        seen = self._honeycomb.watch(pixels, probe.light, is_placed=view.state == "following")
        if seen == "another":
            return replace(view, state="lost", advice="another bundle")
        if seen != "moved":
            return view
        x, y = self._honeycomb.shift
        self.bundle = self.bundle.moved(np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]]))
        probe.see_through(self.bundle)
        # What was seen beside the cores would hold the next frames where the bundle was.
        probe.begin_anew()
        self._honeycomb = None
        if self._improving is not None:
            self._improving.forget()
        return replace(view, advice="the bundle has moved")

    def _improve(self, probe: "Probe", pixels: NDArray[Any]) -> None:
        """Let the gains be measured by a frame too, and go on with better ones once there are some."""
        if self._improving is None or self.bundle is None or not self.bundle.is_resolved:
            return
        found = self._improving.take(self.bundle, pixels, probe.light)
        if found is not None and found.bundle is not self.bundle:
            self.bundle = found.bundle
            probe.see_through(found.bundle)
            if found.was_off:
                probe.forget(_KEPT)

    def _told(self, state: State, advice: Advice, pixels: NDArray[Any], seconds: float | None) -> LiveView:
        """Return the last picture, or else the frame without its honeycomb, with another state."""
        before = self._view
        image = self._calibration.picture(pixels) if before is None else before.image
        return LiveView(
            image=image,
            homography=np.eye(3) if before is None else before.homography,
            state=state,
            advice=advice,
            piece=0 if before is None else before.piece,
            seconds=seconds,
        )


def _checked(frame: ArrayLike) -> NDArray[Any]:
    pixels = np.asarray(frame)
    if pixels.dtype.kind not in "uif" or pixels.ndim not in (2, 3) or min(pixels.shape[:2]) < MIN_SIDE:
        raise BurstError(
            f"a live frame is (H, W) or (H, W, C), {MIN_SIDE} pixels a side at least, integers or floats; got shape "
            f"{pixels.shape} of {pixels.dtype}"
        )
    return pixels


def _size(pixels: NDArray[Any]) -> str:
    return " x ".join(map(str, pixels.shape))

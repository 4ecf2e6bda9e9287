"""Burst: frames of one object through one bundle, and what is known of their recording."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_fiberburst.data.layout import Layout
from napari_fiberburst.errors import BurstError

MIN_SIDE = 16
# Values of a frame, pixels times channels; as float32 they take 1 GiB.
MOST_VALUES = 2**28
_FULL_SCALES = tuple(2**bits - 1 for bits in range(8, 33, 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Acquisition:
    """What is known of a recording beside its pixels.

    Attributes
    ----------
    shape : tuple of int
        Frames, height, width and channels of the burst.
    axes : str
        "TYX" for grey frames, "TYXC" for frames with a channel axis.
    dtype : numpy.dtype
        Type of the pixels as they came.
    black_level, white_level : float
        Original intensities that stand at 0 and 1.
    channel_names : tuple of str
        One per channel; empty where they are not known.
    pixel_size : (float, float) or None
        Height and width of a pixel, in `unit`.
    unit : str or None
        Unit of length, such as "µm".
    times : numpy.ndarray or None
        (T,) seconds at which the frames were taken.
    origin : (int, int)
        Row and column of the first pixel in the image that the burst was cropped from.
    """

    shape: tuple[int, int, int, int]
    axes: str
    dtype: np.dtype[Any]
    black_level: float
    white_level: float
    channel_names: tuple[str, ...] = ()
    pixel_size: tuple[float, float] | None = None
    unit: str | None = None
    times: NDArray[np.float64] | None = None
    origin: tuple[int, int] = (0, 0)

    @property
    def nbytes(self) -> int:
        """Bytes of the frames as they came."""
        return int(np.prod(self.shape)) * self.dtype.itemsize

    def in_original_units(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Scale (H, W, C) values from [0, 1] back to the recording's intensities; grey loses its channel axis."""
        scaled = values * np.float32(self.white_level - self.black_level) + np.float32(self.black_level)
        return scaled if "C" in self.axes else scaled[..., 0]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values that JSON can hold; `from_dict` reads them back."""
        plain = {item.name: getattr(self, item.name) for item in fields(Acquisition)}
        times = None if self.times is None else self.times.tolist()
        return {**plain, "dtype": self.dtype.name, "times": times}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "Acquisition":
        """Rebuild an acquisition from `to_dict`'s values."""
        known = {name: tuple(value) if isinstance(value, list) else value for name, value in plain.items()}
        times = None if plain["times"] is None else np.array(plain["times"], dtype=np.float64)
        return Acquisition(**{**known, "dtype": np.dtype(plain["dtype"]), "times": times})


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Burst(Acquisition):
    """Some 10 to 20 frames of one object that moves behind a fibre bundle.

    Parameters
    ----------
    frames : array_like
        (T, H, W) or (T, H, W, C), any number of channels; unsigned or signed integers or floats, numpy or dask.
    axes : str, optional
        The order of the axes where it is another, such as "CTYX". T, Y, X must be there; axes other than these and
        C must have length 1 and are dropped. S (samples) and C are the same.
    black_level, white_level : float, optional
        Intensities that become 0 and 1; what lies beyond is clipped. For integers the default is 0 and the least
        full scale of 8, 10, 12 and so on up to 32 bits that holds all values; for floats 0 and 1, widened where values
        lie beyond.
    channel_names : sequence of str, optional
        One name per channel.
    pixel_size : float or (float, float), optional
        Side of a pixel, or its height and width, in `unit`.
    unit : str, optional
        Unit of length.
    times : array_like, optional
        (T,) seconds.

    Attributes
    ----------
    frames : numpy.ndarray
        (T, H, W, C) float32 in [0, 1], contiguous.

    Raises
    ------
    BurstError
        The frames cannot be a burst; the message says what was expected, what came and what to do.

    Notes
    -----
    Memory: one float32 copy, 4 bytes x T x H x W x C (20 RGB frames of 600 x 600 take 86 MB), beside the array
    handed in; nothing is kept of the latter. Frames are converted one at a time, so a dask array is never whole
    in memory in its own type.
    """

    frames: NDArray[np.float32]

    def __init__(
        self,
        frames: ArrayLike,
        *,
        axes: str | None = None,
        black_level: float | None = None,
        white_level: float | None = None,
        channel_names: Sequence[str] = (),
        pixel_size: float | tuple[float, float] | None = None,
        unit: str | None = None,
        times: ArrayLike | None = None,
    ) -> None:
        # numpy and dask arrays are sliced as they are
        stack: Any = frames if hasattr(frames, "__array_function__") else _stack(frames)
        layout = Layout.of(stack.shape, axes)
        values = _to_float(stack, layout)
        dtype = np.dtype(stack.dtype)
        black, white = choose_levels(dtype, float(values.min()), float(values.max()), black_level, white_level)
        values -= np.float32(black)
        with np.errstate(over="ignore"):  # far above a white level that is tiny
            values /= np.float32(white - black)
        np.clip(values, 0, 1, out=values)
        _check_contents(values)
        super().__init__(
            shape=values.shape,
            axes=layout.axes,
            dtype=dtype,
            black_level=black,
            white_level=white,
            channel_names=_names(channel_names, values.shape[3]),
            pixel_size=_pixel_size(pixel_size),
            # Unicode has two; OME-TIFF knows the micro sign alone, and some libraries write the Greek letter.
            unit=None if unit is None else unit.replace("\N{GREEK SMALL LETTER MU}", "\N{MICRO SIGN}"),
            times=_times(times, values.shape[0]),
        )
        _set(self, "frames", values)

    def __repr__(self) -> str:
        count, height, width, channels = self.shape
        return f"Burst({count} frames of {height} x {width}, {channels} channels, {self.dtype})"

    def crop(self, rows: tuple[int, int], columns: tuple[int, int]) -> "Burst":
        """Return the part [y0, y1) x [x0, x1) of every frame; `origin` remembers where it was.

        Raises
        ------
        BurstError
            The crop is empty, leaves the image, or is under 16 pixels on a side.
        """
        for axis, (start, stop), size in zip("yx", (rows, columns), self.shape[1:3], strict=True):
            if not all(isinstance(edge, int | np.integer) for edge in (start, stop)) or not 0 <= start < stop <= size:
                raise BurstError(f"a crop must lie inside the image, {axis} within 0:{size}; got {start}:{stop}")
        part = np.ascontiguousarray(self.frames[:, slice(*rows), slice(*columns)])
        check_size(part.shape)
        _check_contents(part)
        cropped = copy(self)
        _set(cropped, "shape", part.shape)
        _set(cropped, "origin", (self.origin[0] + rows[0], self.origin[1] + columns[0]))
        _set(cropped, "frames", part)
        return cropped

    @property
    def acquisition(self) -> Acquisition:
        """What is known of the recording, without the pixels."""
        return Acquisition(**{item.name: getattr(self, item.name) for item in fields(Acquisition)})


# How a frozen dataclass sets its own fields where it makes them itself.
_set = object.__setattr__


def _stack(frames: Any) -> NDArray[Any]:
    try:
        parts = [np.asarray(frame) for frame in frames]
    except TypeError as error:
        raise BurstError(
            f"a burst is an array (time, height, width[, channel]), a list of frames, or a path; got {frames!r:.80}"
        ) from error
    try:
        return np.stack(parts)
    except ValueError as error:
        shapes = ", ".join(str(shape) for shape in sorted({part.shape for part in parts})[:4])
        raise BurstError(
            f"a burst needs frames of one shape; got {len(parts)} of the shapes {shapes}; crop them to one size"
        ) from error


def check_size(shape: tuple[int, ...]) -> None:
    """Refuse frames (T, H, W, C) that are none, too small, or larger than any camera's.

    Raises
    ------
    BurstError
        They are.
    """
    if shape[0] < 1:
        raise BurstError("a burst needs at least one frame, got none; check the file or the slice it comes from")
    if min(shape[1:3]) < MIN_SIDE or shape[3] < 1:
        raise BurstError(
            f"frames need at least {MIN_SIDE} pixels a side, got {shape[1]} x {shape[2]} with {shape[3]} channels; "
            'if the axes stand in another order, name them: Burst(frames, axes="TCYX"), read_burst(path, axes="TCYX")'
        )
    check_frame(*shape[1:])


def check_frame(height: int, width: int, channels: int) -> None:
    """Refuse a frame that is larger than any camera's, before memory is taken for it.

    Raises
    ------
    BurstError
        It has more than 2**28 values.
    """
    if int(height) * int(width) * int(channels) > MOST_VALUES:
        raise BurstError(
            f"a frame may have {MOST_VALUES:,} values (pixels times channels) at most, got {height} x {width} with "
            f"{channels} channels; crop it, or check the file, which may be damaged"
        )


def check_acquisition(known: Acquisition) -> None:
    """Refuse what a file says of a recording where no recording is like that.

    Raises
    ------
    ValueError, TypeError
        It is not; those of a burst are BurstErrors.
    """
    if len(known.shape) != 4 or not all(isinstance(side, int) and side > 0 for side in known.shape):
        raise BurstError(f"expected frames, height, width and channels; got {known.shape}")
    frames, height, width, channels = known.shape
    check_frame(height, width, channels)
    check_dtype(known.dtype)
    if known.axes not in ("TYX", "TYXC") or (known.axes == "TYX" and channels > 1):
        raise BurstError(f"frames of {channels} channels cannot have the axes {known.axes!r}")
    choose_levels(known.dtype, 0, 0, known.black_level, known.white_level)
    if not all(isinstance(name, str) for name in known.channel_names) or not isinstance(known.unit, str | None):
        raise BurstError(f"names and units must be text; got {known.channel_names} and {known.unit!r}")
    _names(known.channel_names, channels)
    if known.pixel_size is not None and len(known.pixel_size) != 2:
        raise BurstError(f"expected height and width of a pixel; got {known.pixel_size}")
    _pixel_size(known.pixel_size)
    _times(known.times, frames)
    if len(known.origin) != 2 or not all(isinstance(at, int) and 0 <= at < MOST_VALUES for at in known.origin):
        raise BurstError(f"expected the row and column that frames were cropped at; got {known.origin}")


def check_dtype(dtype: np.dtype[Any]) -> None:
    """Refuse pixels that are no intensities.

    Raises
    ------
    BurstError
        They are neither integers nor floats.
    """
    if dtype.kind not in "uif":
        raise BurstError(f"frames must hold integers or floats, got {dtype}; convert them to uint8, uint16 or float32")


def _to_float(frames: Any, layout: Layout) -> NDArray[np.float32]:
    """Convert frame by frame, and refuse values that no camera gives."""
    check_size(layout.shape)
    check_dtype(np.dtype(frames.dtype))
    values = np.empty(layout.shape, np.float32)
    for index in range(len(values)):
        values[index] = layout.take(frames, index, index + 1)[0]
        if not np.isfinite(values[index]).all():
            raise BurstError(
                f"frames must be finite, but frame {index} holds NaN or infinity; replace those pixels or leave "
                "the frame out"
            )
    return values


def _check_contents(values: NDArray[np.float32]) -> None:
    if all(np.ptp(frame) == 0 for frame in values):
        raise BurstError(
            "every frame is constant, so there is nothing to see; check the exposure, the levels, the crop, and the "
            "file that was opened"
        )


def choose_levels(
    dtype: np.dtype[Any], low: float, high: float, black: float | None, white: float | None
) -> tuple[float, float]:
    """Return the levels of no light and of full scale of pixels of a type that have values from low to high.

    Raises
    ------
    BurstError
        Those that are asked for are no levels.
    """
    if dtype.kind == "f":
        low, full = min(low, 0.0), max(high, 1.0)
    else:
        low, full = min(low, 0.0), float(next((full for full in _FULL_SCALES if full >= high), high))
    try:
        black = low if black is None else float(black)
        white = full if white is None else float(white)
    except (TypeError, ValueError) as error:
        raise BurstError(f"black and white level must be numbers; got {black!r} and {white!r}") from error
    with np.errstate(over="ignore"):  # frames are float32, in which the levels must differ, too
        span, lowest = np.float32(white - black), np.float32(black)
    if not (np.isfinite(span) and np.isfinite(lowest) and span > 0):
        raise BurstError(
            f"the black level must be below the white level, both between -3e38 and 3e38; got {black:g} and {white:g}"
        )
    return black, white


def _names(names: Sequence[str], channels: int) -> tuple[str, ...]:
    if names and len(names) != channels:
        raise BurstError(f"expected one name for each of the {channels} channels; got {list(names)}")
    return tuple(names)


def _pixel_size(size: float | tuple[float, float] | None) -> tuple[float, float] | None:
    if size is None:
        return None
    try:
        height, width = (float(side) for side in np.broadcast_to(size, 2))
    except (TypeError, ValueError) as error:
        raise BurstError(f"a pixel size must be one number or (height, width); got {size!r}") from error
    if not (0 < height < np.inf and 0 < width < np.inf):
        raise BurstError(f"a pixel size must be positive, one number or (height, width); got {size}")
    return height, width


def _times(times: ArrayLike | None, count: int) -> NDArray[np.float64] | None:
    if times is None:
        return None
    try:
        values = np.array(times, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BurstError(f"frame times must be numbers, in seconds; got {times!r}") from error
    if values.shape != (count,) or not np.isfinite(values).all():
        raise BurstError(f"expected one finite time for each of the {count} frames; got {times}")
    return values

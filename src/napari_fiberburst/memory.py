"""How much memory a run takes, told before it starts, and held to where that is asked for."""

from typing import Literal

from napari_fiberburst.errors import MemoryLimitError
from napari_fiberburst.settings import NetworkMethod, PublishedMethod, Settings, Siren, SplineMethod
from napari_fiberburst.settings.settings import bytes_of

Kind = Literal["cores", "pixels"]
# Fitted to what `python -m benchmarks.memory` measures.
_FIXED = 107e6
_PER_VALUE, _PER_PIXEL, _PER_FURTHER_NODE = 18, 112, 300
# Of a sample, and of each of its channels.
_PER_SAMPLE = {"cores": (90, 67), "pixels": (40, 27)}
# Of training: whatever the batch; of a sample as recorded; and of one behind a bundle, and of each of its channels.
_FIXED_OF_TRAINING, _PER_RECORDED, _PER_TAKEN = 190e6, 9, (50, 21)
# Of a unit of the scene network for each point. glibc takes arrays below this size from its heap, and does not fill all
# the holes there. A sine keeps its argument, too.
_HEAP_BELOW, _PER_UNIT_IN_HEAP, _PER_UNIT, _OF_SINE = 2**25, 14, 9.0, 1.15
# Behind a bundle, a core is seen by so many points of its footprint.
_POINTS = {"cores": 7, "pixels": 1}
# Samples to a pixel before the bundle is known: cores that lie close together, or what is lit of them.
_USUAL = {"cores": 0.09, "pixels": 0.61}
# A union canvas is as large as the motion; half a frame more on each axis is much.
_UNION = 2.25
_PUBLISHED_BATCHES = 8
# Parts of a batch below this size would take longer than they save.
_LEAST_PART = 256


def estimate_memory(
    shape: tuple[int, int, int, int],
    settings: Settings,
    *,
    kind: Kind | None = None,
    samples: int | None = None,
    parts: int = 1,
) -> int:
    """Return about how many bytes a run takes beside the burst, float32.

    Parameters
    ----------
    shape : (int, int, int, int)
        T, H, W and C of the burst.
    settings : Settings
        What it will be run with.
    kind : str, optional
        "cores" or "pixels", what the samples of the burst are; by default as asked for, or else cores.
    samples : int, optional
        How many a frame has; by default as many as of cores that lie close together, which is rather too many.
    parts : int
        In which batches of a network go through it.

    Examples
    --------
    >>> estimate_memory((20, 600, 600, 3), Settings()) // 2**20
    443
    """
    frames, height, width, channels = shape
    method = settings.method
    if isinstance(method, PublishedMethod):
        return int(_PER_RECORDED * frames * height * width + _of_training(method, height * width, 1, parts))
    if kind is None:
        kind = "pixels" if method.samples == "pixels" else "cores"
    each = round(_USUAL[kind] * height * width) if samples is None else samples
    union = _UNION if method.canvas == "union" else 1
    finer = method.upsample**2 if isinstance(method, SplineMethod) else 1
    further = height * width * max(0.0, finer * union - 1)
    of_sample, of_channel = _PER_SAMPLE[kind]
    aligning = (
        _FIXED
        + _PER_VALUE * frames * height * width
        + _PER_PIXEL * height * width
        + _PER_FURTHER_NODE * further
        + (of_sample + of_channel * channels) * frames * each
    )
    if isinstance(method, SplineMethod):
        return int(aligning)
    taken = (_PER_TAKEN[0] + _PER_TAKEN[1] * channels) * frames * each
    training = taken + _of_training(method, height * width, _POINTS[kind], parts)
    return int(max(aligning, training))


def _of_training(method: NetworkMethod | PublishedMethod, frame: int, points: int, parts: int) -> float:
    batch = method.batch or -(-frame // _PUBLISHED_BATCHES)
    seen = -(-batch // parts) * points
    each = _PER_UNIT_IN_HEAP if 4 * seen * method.scene_width < _HEAP_BELOW else _PER_UNIT
    sine = _OF_SINE if isinstance(method.encoding, Siren) else 1.0
    return _FIXED_OF_TRAINING + each * sine * seen * method.scene_layers * method.scene_width


class MemoryLimit:
    """What a run may take, by `Settings.memory`.

    Parameters
    ----------
    shape : (int, int, int, int)
        T, H, W and C of the burst.
    settings : Settings
        What it is run with.
    """

    def __init__(self, shape: tuple[int, int, int, int], settings: Settings) -> None:
        self._shape, self._settings = shape, settings
        self._most = None if settings.memory is None else bytes_of(settings.memory)

    def allows(self, kind: Kind, samples: int) -> bool:
        """Whether a run with so many samples a frame fits, in as many parts as it takes."""
        return self._parts(kind, samples) is not None

    def parts(self, kind: Kind | None = None, samples: int | None = None) -> int:
        """Return the least number of parts of a network's batches with which a run fits, a power of two.

        Parameters
        ----------
        kind, samples
            As those of `estimate_memory`.

        Raises
        ------
        MemoryLimitError
            It does not fit in any number of parts.
        """
        parts = self._parts(kind, samples)
        if parts is not None:
            return parts
        needed = estimate_memory(self._shape, self._settings, kind=kind, samples=samples, parts=self._most_parts)
        assert self._most is not None
        raise MemoryLimitError(
            f"this run takes about {in_words(needed)} beside the burst, and memory allows {in_words(self._most)}; "
            'allow more, crop the burst, take fewer frames, lower the upsampling, or take observation="cores"'
        )

    @property
    def _most_parts(self) -> int:
        _, height, width, _ = self._shape
        method = self._settings.method
        batch = 0 if isinstance(method, SplineMethod) else method.batch or height * width // _PUBLISHED_BATCHES
        return max(1, batch // _LEAST_PART)

    def _parts(self, kind: Kind | None, samples: int | None) -> int | None:
        parts = 1
        while self._most is not None:
            if estimate_memory(self._shape, self._settings, kind=kind, samples=samples, parts=parts) <= self._most:
                break
            if parts >= self._most_parts:
                return None
            parts *= 2
        return parts


def in_words(size: int) -> str:
    """Return bytes as a person would say them.

    Examples
    --------
    >>> in_words(1_234_567_890), in_words(45_600_000)
    ('1.2 GB', '46 MB')
    """
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"

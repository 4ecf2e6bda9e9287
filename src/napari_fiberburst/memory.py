"""How much memory a run will take, told before it starts."""

from napari_fiberburst.settings import Settings, Spline

# Fitted to what `benchmarks/memory.py` measures, from above.
_FIXED = 200 * 2**20
_BYTES_PER_SAMPLE, _BYTES_PER_NODE, _BYTES_PER_UNIT = 12, 500, 10
# A union canvas is as large as the motion; half a frame more on each axis is much.
_UNION = 2.25
_PUBLISHED_BATCHES = 8


def estimate_memory(shape: tuple[int, int, int, int], settings: Settings) -> int:
    """Return about how many bytes a run takes beside the burst as it came, rather too many than too few.

    Parameters
    ----------
    shape : (int, int, int, int)
        T, H, W and C of the burst.
    settings : Settings
        What it will be run with.

    Examples
    --------
    >>> estimate_memory((20, 600, 600, 3), Settings()) // 2**20
    618
    """
    frames, height, width, channels = shape
    nodes = height * width * settings.upsample**2 * (_UNION if settings.canvas == "union" else 1)
    samples = frames * height * width * channels
    units = 0
    if not isinstance(settings.encoding, Spline):
        batch = settings.batch or height * width // _PUBLISHED_BATCHES
        units = batch * settings.scene_layers * settings.scene_width
    return int(_FIXED + _BYTES_PER_SAMPLE * samples + _BYTES_PER_NODE * nodes + _BYTES_PER_UNIT * units)

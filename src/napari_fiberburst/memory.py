"""How much memory a run will take, told before it starts."""

from napari_fiberburst.settings import NetworkMethod, PublishedMethod, Settings, SplineMethod

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
    samples = frames * height * width * channels
    method = settings.method
    is_union, units = False, 0
    if isinstance(method, SplineMethod | NetworkMethod):
        is_union = method.canvas == "union"
    if isinstance(method, NetworkMethod | PublishedMethod):
        batch = method.batch or height * width // _PUBLISHED_BATCHES
        units = batch * method.scene_layers * method.scene_width
    nodes = height * width * method.upsample**2 * (_UNION if is_union else 1)
    return int(_FIXED + _BYTES_PER_SAMPLE * samples + _BYTES_PER_NODE * nodes + _BYTES_PER_UNIT * units)

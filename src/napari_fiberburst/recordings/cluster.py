"""Workers for long recordings: processes on this machine, or a dask scheduler that is there."""

import importlib.util
import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from napari_fiberburst.errors import ClusterError
from napari_fiberburst.recordings.refine import TILE_SIDE, halo_of
from napari_fiberburst.recordings.traces import KEPT_PARTS, PART

# Seconds after which a scheduler that does not answer is not there.
_PATIENCE = 8
# What has to be of one version everywhere, because it decides figures, or how they are handed over. Others of dask's
# own list, such as pandas, are not used.
_SAME = ("napari_fiberburst", "distributed", "torch", "numpy", "scipy", "zarr")
# Of a worker, measured from above: what it has before it does anything, with images of frames and their spectra, which
# are of one size for all recordings; bytes to one of the frames that are read together, as float32; how many of these
# there are; and bytes to a node of a tile.
_FIXED, _PER_FRAME_BYTE, _TOGETHER, _PER_NODE = 1100 * 2**20, 5, 2**26, 250
# There is at most one core to so many pixels, because cores nearer than three pixels are not told apart.
_PIXELS_PER_CORE = 8
# Bytes that glibc keeps at the end of its heap, and from which on it asks the system for a piece: its own upper limits.
_KEPT_BY_MALLOC = {"MALLOC_TRIM_THRESHOLD_": 2**26, "MALLOC_MMAP_THRESHOLD_": 2**25}


def unit_memory(shape: tuple[int, int, int, int]) -> int:
    """Return about how many bytes a worker takes for a recording (T, H, W, C), rather too many than too few.

    Examples
    --------
    >>> unit_memory((2000, 256, 256, 1)) // 2**20
    1622
    """
    frames, height, width, channels = shape
    frame = 4 * height * width * channels
    read = _PER_FRAME_BYTE * max(frame, min(_TOGETHER, frame * min(frames, PART)))
    cores = height * width / _PIXELS_PER_CORE
    kept = 4 * cores * (channels + 1) * min(frames, PART * KEPT_PARTS)
    nodes = (TILE_SIDE + 2 * halo_of((height, width))) ** 2
    return int(_FIXED + kept + max(read, _PER_NODE * channels * nodes))


@contextmanager
def workers(
    count: int | None = None, scheduler: str | None = None, shape: tuple[int, int, int, int] | None = None
) -> Iterator[Any | None]:
    """Give a ``distributed.Client`` of workers, or None where none are asked for.

    Parameters
    ----------
    count : int, optional
        So many processes on this machine, of one thread each; they end with the context.
    scheduler : str, optional
        Address of a scheduler that is there, such as ``tcp://10.0.0.1:8786``. Its workers need this package in the same
        version, and see the recording and the output under the same paths.
    shape : (int, int, int, int), optional
        T, H, W and C of the recording, by which it is told whether workers have the memory that they need.

    Raises
    ------
    ClusterError
        The scheduler is not there, runs other versions or has no workers; or memory does not do.
    """
    if count is None and scheduler is None:
        yield None
        return
    if count is not None and scheduler is not None:
        raise ClusterError("workers are started here, or those of a scheduler are asked; give one of the two")
    if importlib.util.find_spec("distributed") is None:
        raise ClusterError(
            "workers need dask.distributed, which is not installed; pip install 'napari-fiberburst[cluster]'"
        )
    import distributed  # noqa: F401, it sets its own levels

    # It would tell of every worker that comes and goes.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    need = 0 if shape is None else unit_memory(shape)
    with _started(count, need) if count is not None else _joined(str(scheduler), need) as client:
        yield client


@contextmanager
def _started(count: int, need: int) -> Iterator[Any]:
    import dask
    from distributed import Client, LocalCluster
    from distributed.system import MEMORY_LIMIT

    if count < 1:
        raise ClusterError(f"expected at least one worker; got {count}")
    if count * need > MEMORY_LIMIT:
        raise ClusterError(
            f"{count} workers need about {_gib(need)} of memory each, and this machine has {_gib(MEMORY_LIMIT)}; take "
            f"{max(1, MEMORY_LIMIT // need)}"
        )
    # What a worker holds, such as traces, can be read again from where it lies; a copy on the disk would be a third.
    kept: dict[str, Any] = {"distributed.worker.memory.target": False, "distributed.worker.memory.spill": False}
    # Dask lets workers give freed memory back at once; torch asks for the same megabytes again in its next operation.
    kept |= {f"distributed.nanny.pre-spawn-environ.{name}": size for name, size in _KEPT_BY_MALLOC.items()}
    with dask.config.set(kept), ExitStack() as opened:
        try:
            cluster = LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=count,
                threads_per_worker=1,
                memory_limit=max(need, MEMORY_LIMIT // count),
                # Without a dashboard its port is asked for all the same, and two commands at once would both want 8787.
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                silence_logs=logging.CRITICAL,
            )
            client = Client(opened.enter_context(cluster))  # type: ignore[no-untyped-call]
        except (RuntimeError, OSError) as error:
            raise ClusterError(f"workers could not be started ({error}); give the same command again") from error
        yield opened.enter_context(client)


@contextmanager
def _joined(address: str, need: int) -> Iterator[Any]:
    from distributed import Client

    try:
        client = Client(address, timeout=_PATIENCE)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ClusterError(
            f"no scheduler answers at {address} ({error}); start one with `dask scheduler`, and give the address that "
            "it prints"
        ) from error
    with client:
        _check(client, address, need)
        yield client


def _check(client: Any, address: str, need: int) -> None:
    known = client.scheduler_info(n_workers=-1)["workers"]
    if not known:
        raise ClusterError(f"the scheduler at {address} has no workers; start some with `dask worker {address}`")
    told = client.get_versions(packages=list(_SAME))
    own = _versions(told["client"])
    for place in (*told["workers"].values(), told["scheduler"]):
        other = _versions(place)
        names = [
            name
            for name in own
            if other.get(name) != own[name] and not (place is told["scheduler"] and other.get(name) is None)
        ]
        if names:
            differences = ", ".join(f"{name} {other.get(name) or 'missing'} there, {own[name]} here" for name in names)
            raise ClusterError(
                f"the scheduler at {address} or its workers run other versions ({differences}); install the same ones"
            )
    limits = [worker["memory_limit"] for worker in known.values() if worker.get("memory_limit")]
    if limits and min(limits) < need:
        raise ClusterError(
            f"a worker of {address} has {_gib(min(limits))} of memory, and this recording needs about {_gib(need)}; "
            "start workers with more"
        )


def _versions(place: dict[str, Any]) -> dict[str, str | None]:
    found = {name: place["packages"].get(name) for name in _SAME}
    python = place["packages"].get("python") or ""
    return found | {"python": ".".join(python.split(".")[:2])}


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"

"""Many reconstructions in one process, and several at once: no growth, and the bits that each gives alone."""

import gc
import hashlib
import multiprocessing
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import joblib
import psutil
from distributed import Client, LocalCluster

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.simulation import simulate
from soak.trials import Count

# Runs after which growth is looked for, as a part of all, and how much memory may grow by.
_SETTLED, _MOST_GROWTH = 0.2, 0.05
_AT_ONCE = 4


def many(count: Count, runs: int) -> None:
    """Reconstruct again and again in this process: memory, handles and threads stay what they were."""
    process = psutil.Process()
    before = (0, 0, 0)
    for number in range(runs):
        (digest_of if number % 2 else _published)(number % 8)
        count.tried += 1
        if number + 1 == int(_SETTLED * runs):
            before = _held(process)
    memory, handles, threads = _held(process)
    if memory > (1 + _MOST_GROWTH) * before[0]:
        count.lose(f"memory grew from {before[0] / 2**20:.0f} to {memory / 2**20:.0f} MiB")
    if handles > before[1]:
        count.lose(f"open files grew from {before[1]} to {handles}")
    if threads > before[2]:
        count.lose(f"threads grew from {before[2]} to {threads}")


def at_once(count: Count, rounds: int) -> None:
    """Reconstruct several at once, in threads and in processes of every kind."""
    alone = [digest_of(seed) for seed in range(_AT_ONCE)]
    spawn, fork = (multiprocessing.get_context(kind) for kind in ("spawn", "fork"))
    for _ in range(rounds):
        for name, run in (
            ("threads", _in_threads),
            ("spawn", lambda: _in_processes(spawn)),
            ("fork", lambda: _in_processes(fork)),
            ("joblib", _by_joblib),
            ("dask", _by_dask),
        ):
            count.tried += _AT_ONCE
            _compare(count, name, run, alone)
    left = [thread.name for thread in threading.enumerate() if thread.name.startswith("soak")]
    if left:
        count.lose(f"threads are left: {left}")


def _burst(seed: int) -> Burst:
    return simulate("histology", shape=(27, 31), frames=3, pitch=4.0, channels=1, seed=seed).burst


def _published(seed: int) -> None:
    """Do a few steps of the published method."""
    reconstruct(_burst(seed), preset="paper", iterations=3, device="cpu")


def digest_of(seed: int) -> str:
    """Return what tells the bits of one small reconstruction from others."""
    return hashlib.sha256(reconstruct(_burst(seed), device="cpu").image.tobytes()).hexdigest()


def _compare(count: Count, name: str, run: Callable[[], list[str]], alone: list[str]) -> None:
    different = [seed for seed, (one, other) in enumerate(zip(run(), alone, strict=True)) if one != other]
    if different:
        count.lose(f"in {name} seeds {different} have other bits than alone")


def _in_threads() -> list[str]:
    with ThreadPoolExecutor(_AT_ONCE, "soak") as pool:
        return list(pool.map(digest_of, range(_AT_ONCE)))


def _in_processes(context: multiprocessing.context.BaseContext) -> list[str]:
    with ProcessPoolExecutor(_AT_ONCE, context) as pool:
        return list(pool.map(digest_of, range(_AT_ONCE)))


def _by_joblib() -> list[str]:
    return list(joblib.Parallel(n_jobs=2)(joblib.delayed(digest_of)(seed) for seed in range(_AT_ONCE)))


def _by_dask() -> list[str]:
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        return list(client.gather(client.map(digest_of, range(_AT_ONCE))))


def _held(process: psutil.Process) -> tuple[int, int, int]:
    gc.collect()
    return process.memory_info().rss, process.num_fds(), process.num_threads()

"""Where to compute, and by how many threads."""

import logging
import os

import torch

from napari_fiberburst.errors import DeviceError

logger = logging.getLogger(__name__)

# What torch says in a RuntimeError like any other: on the CPU under Linux and Windows, and on Apple's GPUs.
_NO_MEMORY = ("can't allocate memory", "not enough memory", "MPS backend out of memory")


def find_device(name: str, *, needs_double: bool = True) -> torch.device:
    """Return the device called `name`; "auto" is cuda where it is, and cpu elsewhere.

    Calibration and registration add many numbers up in double precision, which Apple's GPUs ("mps") do not have;
    `needs_double` is False for what does without.

    Raises
    ------
    DeviceError
        No such device here; the message lists those there are. Or it has no double precision.
    """
    here = _available()
    if name == "auto":
        return torch.device(next(device for device in here if device != "mps"))
    if name == "mps" and name in here and needs_double:
        raise DeviceError(
            "Apple's GPUs have no double precision, which all but the published method needs; take the device 'cpu', "
            "or 'auto', which is the same here"
        )
    if name in here or (name == "cuda" and "cuda:0" in here):
        return torch.device(name)
    raise DeviceError(f"device {name!r} is not on this machine; there are auto, {', '.join(here)}")


def settle_threads() -> None:
    """Let torch use no more threads than there are processors for this process, and say so where it would have.

    Threads that wait for a processor hold up all others at the end of every operation, which makes a reconstruction
    many times as slow.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    processors = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    threads = torch.get_num_threads()
    if threads > processors:
        logger.warning("torch was set to %d threads; the %d processors here take as many", threads, processors)
        torch.set_num_threads(processors)


def _in_forked_child() -> None:
    """Let torch use one thread: those of the parent are not there after a fork, and torch would wait for them."""
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_forked_child)


def missing_devices() -> dict[str, str]:
    """Return the kinds of device that are not on this machine, each with the reason and what would help."""
    here = _available()
    missing = {}
    if not any(name.startswith("cuda") for name in here):
        missing["cuda"] = (
            "this build of PyTorch is for the CPU alone; https://pytorch.org/get-started/locally/ has one with CUDA"
            if torch.version.cuda is None
            else f"PyTorch is built for CUDA {torch.version.cuda}, but finds no NVIDIA GPU with a driver for it"
        )
    if "mps" not in here:
        missing["mps"] = "only Apple computers with an Apple GPU have it, from macOS 12.3 on"
    return missing


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that there was no memory left, on the device or on the machine."""
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _NO_MEMORY)


def free_memory(name: str) -> int | None:
    """Return how many bytes are free on the device called `name`; None where it uses the machine's own memory."""
    device = find_device(name, needs_double=False)
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else None


def _available() -> list[str]:
    """Return the names of this machine's devices, fastest kind first."""
    cuda = [f"cuda:{index}" for index in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    mps = ["mps"] if torch.backends.mps.is_available() else []
    return [*cuda, *mps, "cpu"]

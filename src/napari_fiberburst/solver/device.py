"""Where to compute."""

import torch

from napari_fiberburst.errors import DeviceError


def find_device(name: str) -> torch.device:
    """Return the device called `name`; "auto" is the fastest kind there is: cuda, then mps, then cpu.

    Raises
    ------
    DeviceError
        No such device here; the message lists those there are.
    """
    here = _available()
    if name == "auto":
        return torch.device(here[0])
    if name in here or (name == "cuda" and "cuda:0" in here):
        return torch.device(name)
    raise DeviceError(f"device {name!r} is not on this machine; there are auto, {', '.join(here)}")


def _available() -> list[str]:
    """Return the names of this machine's devices, fastest kind first."""
    cuda = [f"cuda:{index}" for index in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    mps = ["mps"] if torch.backends.mps.is_available() else []
    return [*cuda, *mps, "cpu"]

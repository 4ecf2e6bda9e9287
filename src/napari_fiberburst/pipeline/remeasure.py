"""Step 3: the bundle again, once the frames are registered and the object is known."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from napari_fiberburst.bundle import transmission
from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.samples import sample_cores
from napari_fiberburst.data.burst import Acquisition, Burst
from napari_fiberburst.device import find_device
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.scene.shading import Shading, find_shading


def remeasured(
    bundle: Bundle, registration: Registration, grey: Tensor, acquisition: Acquisition
) -> tuple[Bundle, Registration]:
    """Return the bundle measured anew by grey frames (T, H, W) in [0, 1], and the registration without its gains.

    The gains that were found on the way are in the transmission then. Where the object does not move, or the gains were
    known, both are returned as they are.
    """
    if registration.is_still or bundle.gains_known:
        return bundle, registration
    used = np.flatnonzero(registration.used)
    found = transmission.remeasure(
        bundle,
        grey[torch.from_numpy(registration.used)],
        acquisition,
        lambda number, pixels: registration.predicted(int(used[number]), pixels),
    )
    return found, replace(registration, gains=np.ones_like(registration.gains))


def remeasure(
    burst: Burst, bundle: Bundle, registration: Registration, *, device: str = "auto"
) -> tuple[Bundle, Registration]:
    """Measure the transmission of a bundle anew, once the frames are registered and the object is known.

    Parameters
    ----------
    burst : Burst
        That the bundle was calibrated from.
    bundle : Bundle
        By `calibrate`. One whose gains are known already is returned as it is.
    registration : Registration
        By `register`.
    device : str
        Where to compute.

    Returns
    -------
    Bundle, Registration
        The bundle, and the registration without the gains that are in the bundle now.
    """
    grey = torch.from_numpy(burst.frames).to(find_device(device)).mean(dim=3)
    return remeasured(bundle, registration, grey, burst)


def flatten(
    burst: Burst, bundle: Bundle, registration: Registration, *, device: str = "auto"
) -> tuple[Bundle, Registration]:
    """Take into a bundle how the illumination changes over the frame, as far as the object's motion tells it.

    Parameters
    ----------
    burst : Burst
        The frames.
    bundle : Bundle
        By `remeasure`.
    registration : Registration
        By `refine`.
    device : str
        Where to compute.

    Returns
    -------
    Bundle, Registration
        The bundle, whose gains may differ between channels now, and the registration with the exposures that belong to
        it; the same ones where the light is even, or the object moves too little to tell.
    """
    frames = torch.from_numpy(burst.frames).to(find_device(device))
    shading = find_shading(sample_cores(frames, bundle, burst), registration)
    if shading is None:
        return bundle, registration
    return lit(bundle, shading), shading.exposed(registration)


def lit(bundle: Bundle, shading: Shading) -> Bundle:
    """Return the bundle under this illumination."""
    common = shading.gains.mean(dim=1)
    return transmission.with_gains(bundle, common, shading.gains / common[:, None])

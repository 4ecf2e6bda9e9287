"""Gains where the bundle moves on the camera: in each place of the bundle, pixels cut a core's profile otherwise.

Interpolation brings the cores back to where they were, but not to the brightness that they had there: where the camera
shows sharp cores, gains of one core in two places differ by some per cent, each core's in its own way. So a core has a
gain in each place in which there are frames enough to tell it.
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.registration import Registration

# A place has gains of its own where it has at least so many frames; and so many places have, because each adds as many
# samples as there are cores.
_FEWEST_FRAMES, _MOST_PLACES = 4, 4


def places_with_gains(places: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the places (T,) that have gains of their own, numbered from 0; all other frames share those of the first.

    The first is the place with the most frames.
    """
    counts = np.bincount(places)
    largest = np.argsort(-counts, kind="stable")[:_MOST_PLACES]
    number = np.zeros(len(counts), dtype=np.intp)
    for rank, place in enumerate(largest):
        number[place] = rank if counts[place] >= _FEWEST_FRAMES else 0
    return number[places]


def split_by_place(samples: Samples, places: NDArray[np.intp]) -> Samples:
    """Return samples (T, N) of N cores as samples (T, K N) of K N cores: those in each of K places (T,)."""
    count = int(places.max()) + 1
    here = torch.from_numpy(places).to(samples.weights.device)
    return replace(
        samples,
        positions=samples.positions.repeat(count, 1),
        values=samples.values.repeat(1, count, 1),
        weights=torch.cat([samples.weights * (here == place)[:, None] for place in range(count)], dim=1),
        core_index=torch.cat([samples.core_index + place * samples.cores for place in range(count)]),
        cores=count * samples.cores,
    )


def with_gains_by_place(registration: Registration, places: NDArray[np.intp]) -> Registration:
    """Return the registration of samples that were split by places (T,): gains are those of before in every place."""
    return replace(registration, gains=np.tile(registration.gains, int(places.max()) + 1))


def with_common_gains(
    registration: Registration, samples: Samples, places: NDArray[np.intp]
) -> tuple[Registration, Samples]:
    """Return the registration of split samples with one gain a core, and samples without what places differ by.

    Parameters
    ----------
    registration : Registration
        Of `split_by_place(samples, places)`.
    samples : Samples
        Before they were split.
    places : numpy.ndarray
        (T,), as they were split by.
    """
    logs = np.log(registration.gains.reshape(-1, samples.cores))
    common = np.average(logs, axis=0, weights=np.bincount(places))
    ratios = torch.from_numpy(np.exp(logs - common)[places]).to(samples.values)[:, samples.core_index]
    even = replace(samples, values=samples.values / ratios[..., None], weights=samples.weights * ratios**2)
    return replace(registration, gains=np.exp(common).astype(np.float32)), even

"""What work on a recording comes to: where its frames lie, and the bundle as they have shown it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.transmission import with_gains
from napari_fiberburst.recordings.track import Track


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome:
    """What has come of a recording.

    Attributes
    ----------
    poses : Path
        The table of all frames' places.
    track : Track
        The same.
    bundle : Bundle
        As the frames have shown it: its gains are measured again by all of them, and by every round of refining. It
        can be kept, and a bundle that was given be made better: ``known.updated(outcome)``.
    notes : tuple of str
        What a user should know.
    quality : str
        "good", or "doubtful" where the notes say why frames may lie wrong.
    """

    poses: Path
    track: Track
    bundle: Bundle
    notes: tuple[str, ...]
    quality: Literal["good", "doubtful"]

    @property
    def gain_weights(self) -> NDArray[np.float32]:
        """How much light the gains rest on, (N,), as those of `napari_fiberburst.Reconstruction`."""
        return self.track.gain_weights

    @property
    def gain_ratios(self) -> NDArray[np.float32]:
        """Gains as the recording shows them relative to those of `bundle`, (N,): it has them already."""
        return np.ones(len(self.bundle.centres), np.float32)


def as_seen(bundle: Bundle, track: Track) -> Bundle:
    """Return the bundle of a recording with the gains that its frames have shown."""
    gains = torch.from_numpy(track.gains)
    of_cores = gains.mean(dim=1)
    of_channels = None if gains.shape[1] == 1 else gains / of_cores[:, None]
    seen = with_gains(bundle, of_cores, of_channels)
    return seen if bundle.gains_known else replace(seen, gain_weights=track.gain_weights)

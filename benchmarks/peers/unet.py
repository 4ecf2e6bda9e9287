"""A supervised peer: a small U-Net (Ronneberger et al., 2015) that turns one frame into a clean one.

It has learned from simulated pairs of other scenes (`train_unet.py`), one channel at a time, and uses nothing but the
frame: no bundle, no motion, no other frames.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

WEIGHTS = Path(__file__).with_name("unet.npz")
# Channels at full, half and quarter resolution, and below.
WIDTHS = (16, 32, 64, 96)


class UNet(nn.Module):
    """Frames (N, 1, H, W) in, clean frames of that shape out; H and W are multiples of 8."""

    def __init__(self) -> None:
        super().__init__()
        inputs = (1, *WIDTHS[:-1])
        self.down = nn.ModuleList(_convolutions(before, after) for before, after in zip(inputs, WIDTHS, strict=True))
        pairs = list(pairwise(WIDTHS))
        self.up = nn.ModuleList(_convolutions(above + below, above) for above, below in reversed(pairs))
        self.last = nn.Conv2d(WIDTHS[0], 1, 1)

    def forward(self, frames: Tensor) -> Tensor:
        """Return the clean frames."""
        kept: list[Tensor] = []
        seen = frames
        for number, block in enumerate(self.down):
            seen = block(functional.avg_pool2d(seen, 2) if number else seen)
            kept.append(seen)
        kept.pop()
        for block in self.up:
            wider = functional.interpolate(seen, scale_factor=2.0, mode="bilinear", align_corners=False)
            seen = block(torch.cat([wider, kept.pop()], dim=1))
        found: Tensor = self.last(seen)
        return found


def _convolutions(before: int, after: int) -> nn.Sequential:
    layers = []
    for channels in (before, after):
        layers += [nn.Conv2d(channels, after, 3, padding=1, padding_mode="replicate"), nn.ReLU()]
    return nn.Sequential(*layers)


def save(network: UNet, path: Path) -> None:
    """Write the weights, half precision: what is lost is far below the noise of a frame."""
    np.savez_compressed(path, **{name: value.half().numpy() for name, value in network.state_dict().items()})


def load(path: Path = WEIGHTS) -> UNet:
    """Return the network as `train_unet.py` left it."""
    network = UNet()
    with np.load(path) as weights:
        network.load_state_dict({name: torch.from_numpy(weights[name]).float() for name in weights.files})
    return network.eval()


def clean(frame: NDArray[np.float32], network: UNet) -> NDArray[np.float32]:
    """Return what the network makes of one frame (H, W, C) in [0, 1]."""
    height, width = frame.shape[:2]
    padding = (0, -width % 8, 0, -height % 8)
    channels = torch.from_numpy(np.ascontiguousarray(frame.transpose(2, 0, 1)))[:, None]
    with torch.inference_mode():
        found = network(functional.pad(channels, padding, mode="replicate"))
    image: NDArray[np.float32] = found[:, 0, :height, :width].numpy().transpose(1, 2, 0)
    return image

"""A coordinate network that inpaints: fitted to one frame's core intensities, asked everywhere else.

What implicit neural representations do by themselves (Sitzmann et al., 2020; Tancik et al., 2020), without motion and
without other frames. The layout and the brightness of the cores are given to it.
"""

import numpy as np
import torch
from numpy.typing import NDArray

from napari_fiberburst.networks.scene import make_scene
from napari_fiberburst.settings import Fourier, PublishedMethod
from napari_fiberburst.simulation import Bundle

# Cycles per pitch: finer features than the cores can tell draw noise between them.
PERIODS_PER_PITCH = 0.25
STEPS, BATCH, LEARNING_RATE = 600, 2048, 1e-3


def core_intensities(frame: NDArray[np.float32], bundle: Bundle) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return where the living cores of a frame (H, W, C) are, (N, 2), and what each saw, (N, C)."""
    height, width, channels = frame.shape
    profiles = bundle.profiles((height, width))
    shown = profiles.T @ frame.reshape(-1, channels)
    power = profiles.power(2).sum(axis=0)
    alive = (bundle.gains > 0.05) & (power > 1)
    return bundle.centres[alive], (shown[alive] / (power * bundle.gains)[alive, None]).astype(np.float32)


def inpaint(frame: NDArray[np.float32], bundle: Bundle, *, steps: int = STEPS, seed: int = 0) -> NDArray[np.float32]:
    """Return the image (H, W, C) that a Fourier-feature network draws through one frame's cores."""
    height, width, channels = frame.shape
    generator = torch.Generator().manual_seed(seed)
    sigma = PERIODS_PER_PITCH * max(height, width) / 2 / bundle.pitch
    chosen = PublishedMethod(encoding=Fourier(sigma=sigma))
    network = make_scene(chosen, 2, channels, generator)
    centres, seen = core_intensities(frame, bundle)
    size = np.array([width, height])
    points = torch.from_numpy((2 * (centres + 0.5) / size - 1).astype(np.float32))
    wanted = torch.from_numpy(2 * seen - 1)
    adam = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    for _ in range(steps):
        some = torch.randint(len(points), (min(BATCH, len(points)),), generator=generator)
        loss = (network(points[some]) - wanted[some]).square().mean()
        adam.zero_grad(set_to_none=True)
        loss.backward()
        adam.step()
        schedule.step()
    rows, columns = np.indices((height, width))
    grid = (2 * (np.stack([columns, rows], axis=-1) + 0.5) / size - 1).astype(np.float32)
    with torch.inference_mode():
        drawn = torch.cat([network(part) for part in torch.from_numpy(grid).reshape(-1, 2).split(2**15)])
    image: NDArray[np.float32] = ((drawn + 1) / 2).reshape(height, width, channels).numpy()
    return image

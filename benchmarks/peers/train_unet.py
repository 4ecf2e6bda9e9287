"""Train the supervised peer on simulated pairs: a frame through a bundle, and the scene it saw.

The scenes are random leaves (Lee et al., 2001: opaque discs of all sizes, which have the statistics of natural
images) and photographs of scikit-image that no benchmark shows. Bundles have pitches from 2.6 to 8, and both physics.
On two cores with nothing else to do it takes under 20 minutes; the same seed gives the same pairs in the same order.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import skimage.data
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from torch.optim.lr_scheduler import OneCycleLR

from benchmarks.peers.unet import WEIGHTS, UNet, save
from napari_fiberburst.simulation import Scene, simulate

SIDE = 160
PATCH = 64
BATCH = 8
# What the benchmarks show of scikit-image (histology, retina, cat) is not among these.
PHOTOGRAPHS = (
    "astronaut",
    "brick",
    "camera",
    "coffee",
    "coins",
    "grass",
    "gravel",
    "hubble_deep_field",
    "moon",
    "rocket",
)


def leaves(rng: Generator, side: int) -> NDArray[np.float32]:
    """Return a grey image of opaque discs, the newest on top; radii fall off with their third power."""
    image = np.full((side, side), rng.random(), np.float32)
    rows, columns = np.ogrid[:side, :side]
    for _ in range(600):
        radius = 2.0 / np.sqrt(rng.uniform((2.0 / (side / 3)) ** 2, 1))
        x, y = rng.uniform(-radius, side + radius, 2)
        inside = (columns - x) ** 2 + (rows - y) ** 2 <= radius**2
        image[inside] = rng.beta(0.6, 0.6) + rng.normal(0, 0.02)
    return np.clip(image, 0, 1)


def photograph(rng: Generator, side: int) -> NDArray[np.float32]:
    """Return a part of a photograph, one of its channels, turned and mirrored at random."""
    whole = getattr(skimage.data, str(rng.choice(PHOTOGRAPHS)))()
    whole = np.atleast_3d(whole)[..., : 3 if whole.ndim == 3 else 1]
    y, x = (rng.integers(0, max(1, length - side)) for length in whole.shape[:2])
    part = whole[y : y + side, x : x + side, rng.integers(whole.shape[2])].astype(np.float32) / 255
    return np.rot90(part, int(rng.integers(4)))


def make_pairs(count: int, rng: Generator) -> tuple[Tensor, Tensor]:
    """Return frames and the scenes they saw, each (count, 1, SIDE, SIDE)."""
    frames, truths = [], []
    for number in range(count):
        image = (leaves if number % 2 else photograph)(rng, SIDE)
        shape = (min(SIDE, image.shape[0]), min(SIDE, image.shape[1]))
        simulated = simulate(
            Scene(image[..., None]),
            shape=shape,
            frames=2,
            pitch=float(rng.uniform(2.6, 8)),
            physics=str(rng.choice(["mask", "core"])),
            motion=np.tile(np.eye(3), (2, 1, 1)),
            seed=int(rng.integers(2**31)),
        )
        if shape == (SIDE, SIDE):
            frames.append(simulated.burst.frames[0, ..., 0])
            truths.append(simulated.truth[0, ..., 0])
    return tuple(torch.from_numpy(np.stack(part))[:, None] for part in (frames, truths))  # type: ignore[return-value]


def batches(frames: Tensor, truths: Tensor, rng: Generator) -> tuple[Tensor, Tensor]:
    """Return random patches, each turned and mirrored as chance will have it."""
    pairs = []
    for index in rng.integers(0, len(frames), BATCH):
        y, x = rng.integers(0, SIDE - PATCH, 2)
        pair = torch.cat([frames[index], truths[index]])[:, y : y + PATCH, x : x + PATCH]
        pair = torch.rot90(pair, int(rng.integers(4)), (1, 2))
        pairs.append(pair.flip(2) if rng.random() < 0.5 else pair)
    both = torch.stack(pairs)
    return both[:, :1], both[:, 1:]


def main() -> None:
    """Make the pairs, train, write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=WEIGHTS)
    parser.add_argument("--pairs", type=int, default=1200)
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    rng = np.random.default_rng(options.seed)
    start = time.perf_counter()
    frames, truths = make_pairs(options.pairs, rng)
    unseen = make_pairs(max(8, options.pairs // 20), np.random.default_rng(options.seed + 1))
    print(f"{len(frames)} pairs in {time.perf_counter() - start:.0f} s", flush=True)
    network = UNet()
    adam = torch.optim.Adam(network.parameters())
    schedule = OneCycleLR(adam, max_lr=2e-3, total_steps=options.steps)
    for step in range(1, options.steps + 1):
        seen, wanted = batches(frames, truths, rng)
        loss = functional.mse_loss(network(seen), wanted)
        adam.zero_grad(set_to_none=True)
        loss.backward()
        adam.step()
        schedule.step()
        if step % max(1, options.steps // 20) == 0:
            with torch.inference_mode():
                error = functional.mse_loss(network(unseen[0]), unseen[1]).item()
            seconds = time.perf_counter() - start
            print(
                f"step {step}: {loss.item():.5f}, unseen pairs {-10 * np.log10(error):.2f} dB, {seconds:.0f} s",
                flush=True,
            )
    save(network, options.output)
    print(f"wrote {options.output}, {options.output.stat().st_size / 2**20:.2f} MiB")


if __name__ == "__main__":
    main()

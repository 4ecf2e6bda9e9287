"""What a step of the `paper` preset costs beside the bare forward, backward and Adam of the same networks.

The bare step has its batch ready: what is left is drawing samples, bookkeeping and reports. The two are timed in turn,
and the figure is the median of their ratios pair by pair.
"""

import statistics
import time
from collections.abc import Callable

import torch

from napari_fiberburst.networks.field import JointField
from napari_fiberburst.networks.training import BETAS, Problem
from napari_fiberburst.pipeline.reconstruct import iterate
from napari_fiberburst.settings import PublishedMethod, Settings
from napari_fiberburst.simulation import simulate

SHAPE = (256, 256)
PAIRS = 15
STEPS = 4


def bare(field: JointField, problem: Problem) -> Callable[[], None]:
    """Return a step with nothing but the networks, on one batch."""
    batch = problem.samples.draw(problem.batch)
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-4, betas=BETAS)

    def step() -> None:
        loss = (field(batch.points, batch.frames) - batch.intensities).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def seconds(function: Callable[[], object]) -> float:
    """Return how long a number of calls take."""
    start = time.perf_counter()
    for _ in range(STEPS):
        function()
    return time.perf_counter() - start


def main() -> None:
    """Measure and print."""
    method = PublishedMethod(iterations=(PAIRS + 1) * STEPS)
    burst = simulate("histology", shape=SHAPE, seed=0).burst
    problem = Problem(burst, method, torch.device("cpu"))
    step = bare(JointField(method, burst.shape), problem)
    # Every step reports here, which is more often than a run would.
    run = iterate(burst, Settings(method=method, device="cpu"))
    ratios, times = [], []
    for _ in range(PAIRS + 1):
        before = seconds(step)
        ours = seconds(lambda: next(run))
        ratios.append(ours / before)
        times.append(ours / STEPS)
    ratios, times = ratios[1:], times[1:]  # the first pair warms up
    print(f"burst {burst}, batches of {problem.batch}, {torch.get_num_threads()} threads")
    print(f"a step: {statistics.median(times) * 1e3:.0f} ms")
    print(
        f"over the bare networks: {statistics.median(ratios):.3f} x "
        f"(lowest {min(ratios):.3f}, highest {max(ratios):.3f}, {PAIRS} pairs); limit 1.1 x"
    )


if __name__ == "__main__":
    main()

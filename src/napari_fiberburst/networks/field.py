"""The joint field: what every frame of the burst should show."""

import torch
from torch import Tensor, nn

from napari_fiberburst.networks.motion import make_motion
from napari_fiberburst.networks.scene import make_scene
from napari_fiberburst.settings import TrainedMethod


class JointField(nn.Module):
    """I_hat(x, y, t) = f(gamma(T_g(x, y, t))), "Seeing through fibers" (2026).

    Parameters
    ----------
    method : NetworkMethod or PublishedMethod
        Motion, encoding and sizes of the networks.
    shape : (int, int, int, int)
        Frames, height, width and channels of the burst.
    seed : int
        Of the networks' start.
    start : Tensor, optional
        (T, 3, 3) homographies in unit coordinates, from a registration.
    """

    def __init__(
        self, method: TrainedMethod, shape: tuple[int, int, int, int], *, seed: int = 0, start: Tensor | None = None
    ) -> None:
        super().__init__()
        frames, height, width, channels = shape
        generator = torch.Generator().manual_seed(seed)
        self.motion = make_motion(method.motion, frames, (height, width), generator, start)
        self.scene = make_scene(method, self.motion.scene_dimensions, channels, generator)

    def forward(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return intensities (N, C) in [-1, 1] at `points` (N, 2), unit coordinates, of frames (N,)."""
        intensities: Tensor = self.scene(self.motion(points, frames))
        return intensities

    @property
    def parameter_count(self) -> int:
        """Numbers that are fitted; random frequencies are not among them."""
        return sum(parameter.numel() for parameter in self.parameters())

"""Motion fields g: where in the scene each pixel of each frame looks."""

from abc import ABC, abstractmethod
from typing import assert_never

import numpy as np
import torch
from torch import Generator, Tensor, nn

from napari_fiberburst import settings
from napari_fiberburst.coordinates import half_frame_from_pixel, relative_to, transform_points, unit_from_pixel
from napari_fiberburst.motion.models import generators
from napari_fiberburst.networks.layers import make_mlp, make_siren, output_of, zero_output

# A flow field is inverted to 1e-4 of half a frame: about 0.03 px of 600.
_INVERSION_STEPS = 30
_INVERSION_TOLERANCE = 1e-4


class MotionField(nn.Module, ABC):
    """Map points of a frame into the scene, both in unit coordinates of frame 0.

    Parameters
    ----------
    frames : int
        Length of the burst; its times are spread over [-1, 1].

    Attributes
    ----------
    scene_dimensions : int
        Coordinates that the scene is a function of: 2 for (x, y), 3 for (x, y, t).
    """

    scene_dimensions = 2
    times: Tensor

    def __init__(self, frames: int) -> None:
        super().__init__()
        self.register_buffer("times", torch.linspace(-1, 1, frames))

    @abstractmethod
    def forward(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return scene points (N, scene_dimensions) for `points` (N, 2) of the frames numbered `frames` (N,)."""

    def scene_from_frame(self) -> Tensor:
        """Return homographies (T, 3, 3) in unit coordinates; the identity for motions that have none."""
        return torch.eye(3, device=self.times.device).expand(len(self.times), 3, 3)

    def roughness(self, points: Tensor, frames: Tensor) -> Tensor | None:
        """Return what a prior on the motion adds to the loss, or None where there is no prior."""
        return None

    def frame0_points(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return where frame 0 shows what each point (N, 2) of its frame shows; NaN where that is nowhere.

        Frame 0's own map is inverted by fixed-point iteration, which converges where that map bends by less
        than its argument moves.
        """
        target = self(points, frames)
        first = torch.zeros_like(frames)
        found = target
        for _ in range(_INVERSION_STEPS):
            missed = target - self(found, first)
            found = found + missed
        return torch.where(missed.abs().amax(dim=1, keepdim=True) < _INVERSION_TOLERANCE, found, torch.nan)


class StillField(MotionField):
    """No motion, T(x, y, t) = (x, y, t): the scene memorises space and time."""

    scene_dimensions = 3

    def forward(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return (N, 3): the points, and the time of each one's frame."""
        return torch.cat([points, self.times[frames, None]], dim=1)

    def frame0_points(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return the points themselves."""
        return points


class HomographyField(MotionField):
    """M_t = g(t), 3x3 with bottom right element 1, from a ReLU network of time.

    Started as published: the bias of the last layer is the identity, and all else is as torch starts it. So frames
    start some pixels apart, and the honeycomb, which does not move, cannot be explained by a scene that does not
    either. From a start at the identity itself the fit often ends in a still honeycomb.
    """

    def __init__(self, frames: int, choice: settings.HomographyNetwork, generator: Generator) -> None:
        super().__init__(frames)
        self.network = make_mlp([1, *[choice.motion_width] * choice.motion_layers, 8], generator)
        nn.init.zeros_(output_of(self.network).bias)  # the identity is added to what the network returns

    def scene_from_frame(self) -> Tensor:
        """Return M_t for every frame, (T, 3, 3)."""
        change = nn.functional.pad(self.network(self.times[:, None]), (0, 1))
        return torch.eye(3, device=change.device) + change.view(-1, 3, 3)

    def forward(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return (N, 2): M_t applied to each point. The network runs once a frame, not once a point."""
        # A look-up by embedding: its gradient sums in one order, where that of indexing is left to races of threads.
        matrices = nn.functional.embedding(frames, self.scene_from_frame().flatten(1)).view(-1, 3, 3)
        return transform_points(matrices, points[:, None])[:, 0]

    def frame0_points(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return inv(M_0) M_t applied to each point."""
        scene_from_frame = self.scene_from_frame().detach().cpu().numpy().astype(np.float64)
        frame0_from_frame = torch.from_numpy(relative_to(scene_from_frame, 0)).to(points)
        return transform_points(frame0_from_frame[frames], points[:, None])[:, 0]


class AlignedField(MotionField):
    """One transform per frame, from where a registration has put it along the generators of its model.

    Parameters
    ----------
    start : Tensor
        (T, 3, 3) homographies in unit coordinates.
    shape : (int, int)
        Height and width of a frame. Generators move half frames, in which a rotation is one on frames of any shape,
        where in unit coordinates it would shear all that is not square.
    dof : int
        How many generators move: 2 for translations to 8 for homographies; 0 for none.
    """

    start: Tensor

    def __init__(self, start: Tensor, shape: tuple[int, int], dof: int) -> None:
        super().__init__(len(start))
        self.register_buffer("start", start.clone())
        half_from_unit = torch.from_numpy(half_frame_from_pixel(shape) @ np.linalg.inv(unit_from_pixel(shape)))
        in_unit = torch.linalg.inv(half_from_unit) @ generators(dof) @ half_from_unit
        self.register_buffer("generators", in_unit.to(start.dtype), persistent=False)
        self.steps = nn.Parameter(torch.zeros(len(start), dof))

    def scene_from_frame(self) -> Tensor:
        """Return exp(steps) start for every frame, (T, 3, 3)."""
        change = torch.linalg.matrix_exp(torch.einsum("tk,kij->tij", self.steps, self.get_buffer("generators")))
        scene_from_frame: Tensor = change @ self.start
        return scene_from_frame

    def forward(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return (N, 2): each point, transformed as its frame is."""
        matrices = nn.functional.embedding(frames, self.scene_from_frame().flatten(1)).view(-1, 3, 3)
        return transform_points(matrices, points[:, None])[:, 0]


class FlowField(MotionField):
    """(x + dx, y + dy) with (dx, dy) = g(x, y, t), a sine network; (x, y) is first put where a registration says."""

    start: Tensor | None

    def __init__(
        self,
        frames: int,
        choice: settings.Flow | settings.FlowTV,
        generator: Generator,
        start: Tensor | None = None,
    ) -> None:
        super().__init__(frames)
        self.register_buffer("start", start)
        widths = [3, *[choice.motion_width] * choice.motion_layers, 2]
        self.network = make_siren(widths, choice.flow_omega_0, generator)
        zero_output(self.network)
        self.tv_weight = choice.tv_weight if isinstance(choice, settings.FlowTV) else 0.0

    def forward(self, points: Tensor, frames: Tensor) -> Tensor:
        """Return (N, 2): each point plus its displacement."""
        displacement: Tensor = self.network(self._places(points, frames))
        return displacement + self._registered(points, frames)

    def scene_from_frame(self) -> Tensor:
        """Return where a registration has put the frames, (T, 3, 3); the identity without one."""
        return super().scene_from_frame() if self.start is None else self.start

    def roughness(self, points: Tensor, frames: Tensor) -> Tensor | None:
        """Return the weighted mean absolute Jacobian of g over x, y and t."""
        if not self.tv_weight:
            return None
        places = self._places(points, frames).requires_grad_()
        displacement = self.network(places)
        rows = [torch.autograd.grad(displacement[:, axis].sum(), places, create_graph=True)[0] for axis in range(2)]
        return self.tv_weight * torch.stack(rows).abs().mean()

    def _registered(self, points: Tensor, frames: Tensor) -> Tensor:
        return points if self.start is None else transform_points(self.start[frames], points[:, None])[:, 0]

    def _places(self, points: Tensor, frames: Tensor) -> Tensor:
        return torch.cat([points, self.times[frames, None]], dim=1)


def make_motion(
    choice: settings.NetworkMotion | settings.PublishedMotion,
    frames: int,
    shape: tuple[int, int],
    generator: Generator,
    start: Tensor | None = None,
) -> MotionField:
    """Build the motion field that the settings ask for.

    Parameters
    ----------
    choice : Motion
        Which one.
    frames : int
        Length of the burst.
    shape : (int, int)
        Height and width of a frame.
    generator : torch.Generator
        Source of all random numbers, on the CPU.
    start : Tensor, optional
        (T, 3, 3) homographies in unit coordinates, where a registration has put the frames. Without, all start at the
        identity.
    """
    match choice:
        case settings.Flow() | settings.FlowTV():
            return FlowField(frames, choice, generator, start)
        case settings.HomographyNetwork():
            return HomographyField(frames, choice, generator)
        case settings.NoMotion() if start is None:
            return StillField(frames)
        case settings.NoMotion() | settings.Translation() | settings.Similarity() | settings.Affine():
            pass
        case settings.Homography():
            pass
        case _:
            assert_never(choice)
    start = torch.eye(3).repeat(frames, 1, 1) if start is None else start
    return AlignedField(start, shape, choice.dof)

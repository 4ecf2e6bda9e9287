"""One fit in the making: the joint field, the samples it is fitted to, and Adam."""

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor

from napari_fiberburst.burst import Burst
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.fields import JointField
from napari_fiberburst.reconstruction import Reconstruction
from napari_fiberburst.settings import Settings
from napari_fiberburst.solver.representation import Representation
from napari_fiberburst.solver.samples import Samples

# As published. Every step sees this part of one frame's worth of pixels, drawn from all frames.
BATCHES_PER_FRAME = 8
BETAS = (0.9, 0.999)

# What two bursts must share to be taken for one.
_IDENTITY = ("shape", "axes", "dtype", "black_level", "white_level", "origin")
# Of the field, of Adam, and how many samples were drawn.
State = tuple[dict[str, Any], dict[str, Any], int]


class Problem:
    """Minimise the mean of |I_hat - I|^2 over the samples, plus the motion's prior where it has one.

    Parameters
    ----------
    burst : Burst
        What to explain.
    settings : Settings
        How.
    device : torch.device
        Where.
    initial : Reconstruction, optional
        Where to go on from; the samples go on from where its run ended, too.

    Raises
    ------
    SettingsError
        `initial` stands for another burst or was made with other networks.
    """

    # Whatever the caller's thread has set, the fit needs gradients, and tensors that can have them.
    @torch.inference_mode(False)
    def __init__(
        self, burst: Burst, settings: Settings, device: torch.device, initial: Reconstruction | None = None
    ) -> None:
        count, height, width, channels = burst.shape
        self.frame_shape = (height, width)
        self.batch = settings.batch or -(-height * width // BATCHES_PER_FRAME)
        self.field = JointField(settings, count, channels).to(device)
        self.optimizer = torch.optim.Adam(self.field.parameters(), lr=settings.learning_rate, betas=BETAS)
        self.samples = Samples(burst, device, settings.seed)
        if initial is not None:
            self._go_on_from(initial, burst, settings)

    @torch.inference_mode(False)
    def step(self) -> Tensor:
        """Take one step of Adam on a fresh batch; return the loss before it, still on the device."""
        batch = self.samples.draw(self.batch)
        with torch.enable_grad():
            predicted = self.field(batch.points, batch.frames)
            loss: Tensor = (predicted - batch.intensities).square().mean()
            roughness = self.field.motion.roughness(batch.points, batch.frames)
            if roughness is not None:
                loss = loss + roughness
            self.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        return loss.detach()

    def set_learning_rate(self, learning_rate: float) -> None:
        """Change Adam's step size."""
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate

    def is_finite(self) -> bool:
        """Whether every parameter is a number. Waits for the device."""
        sums = torch.stack([parameter.detach().sum() for parameter in self.field.parameters()])
        return bool(torch.isfinite(sums).all())

    @torch.inference_mode(False)
    def state(self) -> State:
        """Return a copy of all that a step changes."""
        return deepcopy((self.field.state_dict(), self.optimizer.state_dict(), self.samples.drawn))

    @torch.inference_mode(False)
    def restore(self, state: State) -> None:
        """Return to a state."""
        field, optimizer, drawn = state
        self.field.load_state_dict(field)
        self.optimizer.load_state_dict(optimizer)
        self.samples.drawn = drawn

    def representation(self) -> Representation:
        """Return the state as it is now, to draw or to go on from."""
        state: dict[str, Any] = self.optimizer.state_dict()
        return Representation(self.field, self.frame_shape, state, self.samples.drawn)

    def _go_on_from(self, initial: Reconstruction, burst: Burst, settings: Settings) -> None:
        start = initial.renderer
        here, there = ({name: getattr(of, name) for name in _IDENTITY} for of in (burst, initial.acquisition))
        if not isinstance(start, Representation) or here != there:
            raise SettingsError(f"initial must be a reconstruction of this burst, {here}; it was made from {there}")
        try:
            self.field.load_state_dict(start.field.state_dict())
        except RuntimeError as error:
            raise SettingsError(
                f"initial was made with motion {initial.settings.motion} and encoding {initial.settings.encoding}; "
                f"continue with networks of the same kind and size, not {settings.motion} and {settings.encoding}"
            ) from error
        if start.optimizer_state is not None:
            self.optimizer.load_state_dict(deepcopy(start.optimizer_state))
            self.set_learning_rate(settings.learning_rate)
        if self.field.scene.has_sigma:
            self.field.scene.set_sigma(settings.encoding.sigma)  # type: ignore[union-attr]
        self.samples.drawn = start.drawn

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

_State = tuple[dict[str, Any], dict[str, Any], int]


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
        self._kept: tuple[_State, ...] = ()
        self.keep()

    def step(self) -> Tensor:
        """Take one step of Adam on a fresh batch; return the loss before it, still on the device."""
        batch = self.samples.draw(self.batch)
        with torch.enable_grad():  # whatever the caller's thread has set
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
        return all(bool(torch.isfinite(parameter).all()) for parameter in self.field.parameters())

    def keep(self) -> None:
        """Remember this state, and the one that was remembered before it.

        A state proves good only by the loss of the step after it, so the newest may turn out to be bad.
        """
        state = deepcopy((self.field.state_dict(), self.optimizer.state_dict(), self.samples.drawn))
        self._kept = (*self._kept[-1:], state)

    def restore(self, *, newest: bool) -> None:
        """Return to the state remembered last, or to the one before."""
        field, optimizer, drawn = self._kept[-1 if newest else 0]
        self.field.load_state_dict(field)
        self.optimizer.load_state_dict(optimizer)
        self.samples.drawn = drawn

    def representation(self) -> Representation:
        """Return the state as it is now, to draw or to go on from."""
        state: dict[str, Any] = self.optimizer.state_dict()
        return Representation(self.field, self.frame_shape, state, self.samples.drawn)

    def _go_on_from(self, initial: Reconstruction, burst: Burst, settings: Settings) -> None:
        start = initial.renderer
        if not isinstance(start, Representation) or initial.acquisition.shape != burst.shape:
            raise SettingsError(
                f"initial must be a reconstruction of this burst, shape {burst.shape}; it was made from one of shape "
                f"{initial.acquisition.shape}"
            )
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

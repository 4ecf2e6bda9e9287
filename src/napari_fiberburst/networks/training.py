"""One fit in the making: the joint field, the samples it is fitted to, and Adam."""

import logging
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.coordinates import unit_from_pixel
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.device import is_out_of_memory
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.networks.batches import Batch, BundleStream, PixelStream
from napari_fiberburst.networks.field import JointField
from napari_fiberburst.networks.image import Representation
from napari_fiberburst.networks.motion import AlignedField
from napari_fiberburst.results.reconstruction import Reconstruction
from napari_fiberburst.scene.image import SplineImage
from napari_fiberburst.settings import Encoding, Fourier, Hash, TrainedMethod

logger = logging.getLogger(__name__)

# As published. Every step sees this part of one frame's worth of pixels, drawn from all frames.
BATCHES_PER_FRAME = 8
BETAS = (0.9, 0.999)
# Spread of the Fourier features' frequencies, cycles per pitch: detail between cores is resolved, noise hardly.
_PERIODS_PER_PITCH = 0.3
# Behind a bundle model, and started from a registration, larger steps are safe. Grids learn each place by itself.
_RATE, _RATE_OF_GRIDS = 1e-3, 1e-2
# Motion that is right to a part of a pixel takes this part of the scene's step size.
_PACE_OF_REGISTERED_MOTION = 0.01

# What two bursts must share to be taken for one.
_IDENTITY = ("shape", "axes", "dtype", "black_level", "white_level", "origin")
# Names in files of what Adam knows of each parameter.
_ADAM, _MOMENTS = "adam.", ("step", "exp_avg", "exp_avg_sq")
# Of the field, of Adam, and how many samples were drawn.
State = tuple[dict[str, Any], dict[str, Any], int]


@dataclass(frozen=True, slots=True, eq=False)
class BehindBundle:
    """What a network is fitted to behind a calibrated bundle.

    Attributes
    ----------
    samples : Samples
        Gains taken out.
    homographies : numpy.ndarray
        (T, 3, 3), frame-t pixel to the reference frame's pixel; NaN for frames that are left out.
    held_out : float
        Part of the samples that is left out of the fit.
    offsets : numpy.ndarray or None
        (T, 2), pixels: how far from their positions the samples lie in each frame, where the bundle moves.
    """

    samples: Samples
    homographies: NDArray[np.float64]
    held_out: float
    offsets: NDArray[np.float64] | None = None


class Problem:
    """Minimise the mean of |I_hat - I|^2 over the samples, plus the motion's prior where it has one.

    Parameters
    ----------
    burst : Burst
        What to explain.
    method : NetworkMethod or PublishedMethod
        How.
    device : torch.device
        Where.
    seed : int
        Of the networks' start and of the order of the samples.
    initial : Reconstruction, optional
        Where to go on from; the samples go on from where its run ended, too.
    behind : BehindBundle, optional
        The samples of the bundle and where they lie; without, the frames are fitted as they are, as published.
    parts : int
        In which batches go through the networks, to the same gradients but for rounding; more need less memory.

    Raises
    ------
    SettingsError
        `initial` stands for another burst or was made with other networks.

    Attributes
    ----------
    method : NetworkMethod or PublishedMethod
        The method with what it left open of its encoding, learning rate and batch chosen.
    parts : int
        As given, or more where memory has run out.
    """

    # Whatever the caller's thread has set, the fit needs gradients, and tensors that can have them.
    @torch.inference_mode(False)
    def __init__(
        self,
        burst: Burst,
        method: TrainedMethod,
        device: torch.device,
        *,
        seed: int = 0,
        initial: Reconstruction | None = None,
        behind: BehindBundle | None = None,
        parts: int = 1,
    ) -> None:
        _, height, width, _ = burst.shape
        self.frame_shape = (height, width)
        self.samples: PixelStream | BundleStream
        start = None
        self.batch = method.batch or -(-height * width // BATCHES_PER_FRAME)
        if behind is None:
            self.samples = PixelStream(burst, device, seed)
        else:
            self.samples = BundleStream(behind.samples, behind.held_out, seed, behind.offsets)
            self.batch = min(self.batch, self.samples.count)
            start = _unit_start(behind)
        self.parts = parts
        self.learning_rate = method.learning_rate or _usual_rate(method)
        self.method = replace(
            method,
            encoding=_following_pitch(method.encoding, behind),
            learning_rate=self.learning_rate,
            batch=self.batch,
        )
        self.field = JointField(self.method, burst.shape, seed=seed, start=start).to(device)
        registered = isinstance(self.field.motion, AlignedField)
        self._paces = (1.0, _PACE_OF_REGISTERED_MOTION if registered else 1.0)
        groups = [{"params": part.parameters()} for part in (self.field.scene, self.field.motion)]
        self.optimizer = torch.optim.Adam(groups, lr=self.learning_rate, betas=BETAS)
        self.set_learning_rate(self.learning_rate)
        if initial is not None:
            self._go_on_from(initial, burst)

    @torch.inference_mode(False)
    def step(self) -> Tensor:
        """Take one step of Adam on a fresh batch; return the loss before it, still on the device."""
        batch = self.samples.draw(self.batch)
        while True:
            try:
                loss = self._loss_and_gradients(batch)
                break
            except (MemoryError, RuntimeError) as error:
                if not is_out_of_memory(error) or 2 * self.parts > len(batch.frames):
                    raise
            # Out of the handler, so that the error does not hold what is to be given back.
            self.parts *= 2
            logger.warning("memory ran out; batches go through the networks in %d parts from now on", self.parts)
        self.optimizer.step()
        return loss

    def _loss_and_gradients(self, batch: Batch) -> Tensor:
        """Return the loss of a batch, and leave its gradients, summed over parts of which one is held at a time."""
        self.optimizer.zero_grad()
        count, whole = len(batch.frames), batch.weight
        total = torch.zeros((), device=batch.frames.device)
        for part in batch.split(self.parts):
            with torch.enable_grad():
                loss = self._misfit(part) * (part.weight / whole)
                points = part.points if part.points.ndim == 2 else part.points[:, 0]
                roughness = self.field.motion.roughness(points, part.frames)
                if roughness is not None:
                    loss = loss + roughness * (len(part.frames) / count)
                loss.backward()  # type: ignore[no-untyped-call]
            total += loss.detach()
        return total

    def held_out_rmse(self) -> float | None:
        """Return the root mean square error, intensities in [0, 1], of samples that were left out; None without any."""
        left_out = self.samples.left_out() if isinstance(self.samples, BundleStream) else None
        if left_out is None:
            return None
        with torch.no_grad():
            error: float = float(self._misfit(left_out)) ** 0.5 / 2
        return error

    def _misfit(self, batch: Batch) -> Tensor:
        """Return the mean squared difference of the field and a batch."""
        if batch.points.ndim == 2:
            predicted = self.field(batch.points, batch.frames)
        else:
            count, each, _ = batch.points.shape
            light = self.field(batch.points.reshape(-1, 2), batch.frames.repeat_interleave(each))
            predicted = light.reshape(count, each, -1).mean(dim=1)
        square = (predicted - batch.intensities).square()
        if batch.weights is None:
            mean: Tensor = square.mean()
            return mean
        weighted: Tensor = (square.mean(dim=1) * batch.weights).sum() / batch.weights.sum()
        return weighted

    def set_learning_rate(self, learning_rate: float) -> None:
        """Change Adam's step size."""
        for group, pace in zip(self.optimizer.param_groups, self._paces, strict=True):
            group["lr"] = pace * learning_rate

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

    def stored(self, state: State) -> dict[str, NDArray[Any]]:
        """Return the networks and Adam's moments of a state, by name, as a file can hold them."""
        field, optimizer, _ = state
        moments = {
            f"{_ADAM}{number}.{name}": value
            for number, values in optimizer["state"].items()
            for name, value in values.items()
        }
        return {name: value.cpu().numpy() for name, value in (field | moments).items()}

    @torch.inference_mode(False)
    def state_from(self, stored: dict[str, NDArray[Any]], drawn: int) -> State:
        """Return the state that arrays stand for, as `stored` has given them.

        Raises
        ------
        ValueError
            They are of other networks.
        """
        field, optimizer, _ = self.state()
        moments: dict[int, dict[str, Tensor]] = {}
        for name in [name for name in stored if name.startswith(_ADAM)]:
            number, moment = name.removeprefix(_ADAM).split(".")
            moments.setdefault(int(number), {})[moment] = torch.from_numpy(stored[name].copy())
        networks = {name: part for name, part in stored.items() if not name.startswith(_ADAM)}
        sizes = {name: tuple(value.shape) for name, value in field.items()}
        parameters = [tuple(part.shape) for group in self.optimizer.param_groups for part in group["params"]]
        if sizes != {name: part.shape for name, part in networks.items()} or not all(
            set(moments.get(number, ())) == set(_MOMENTS)
            and all(tuple(moments[number][name].shape) == shape for name in _MOMENTS[1:])
            for number, shape in enumerate(parameters)
        ):
            raise ValueError("its arrays are not those of the networks that it tells of")
        weights = {name: torch.from_numpy(part.copy()) for name, part in networks.items()}
        return weights, {"state": moments, "param_groups": optimizer["param_groups"]}, drawn

    def representation(self, behind: SplineImage | None = None) -> Representation:
        """Return the state as it is now, to draw or to go on from; `behind` is the first image behind the bundle."""
        state: dict[str, Any] = self.optimizer.state_dict()
        return Representation(self.field, self.frame_shape, state, self.samples.drawn, behind)

    def _go_on_from(self, initial: Reconstruction, burst: Burst) -> None:
        start = initial.renderer
        here, there = ({name: getattr(of, name) for name in _IDENTITY} for of in (burst, initial.acquisition))
        if not isinstance(start, Representation) or here != there:
            raise SettingsError(f"initial must be a reconstruction of this burst, {here}; it was made from {there}")
        try:
            self.field.load_state_dict(start.field.state_dict())
        except RuntimeError as error:
            raise SettingsError(
                f"initial was made with {initial.settings.method}; continue with networks of the same kind and size, "
                f"not {self.method}"
            ) from error
        if start.optimizer_state is not None:
            self.optimizer.load_state_dict(deepcopy(start.optimizer_state))
            self.set_learning_rate(self.learning_rate)
        encoding = self.method.encoding
        if isinstance(encoding, Fourier) and encoding.sigma is not None:
            self.field.scene.set_sigma(encoding.sigma)
        self.samples.drawn = start.drawn


def _unit_start(behind: BehindBundle) -> Tensor:
    """Return where registration has put each frame, (T, 3, 3) in unit coordinates; the identity for unused frames."""
    to_unit = unit_from_pixel(behind.samples.shape)
    matrices = behind.homographies.copy()
    matrices[~np.isfinite(matrices).all(axis=(1, 2))] = np.eye(3)
    return torch.from_numpy((to_unit @ matrices @ np.linalg.inv(to_unit)).astype(np.float32))


def _following_pitch(encoding: Encoding, behind: BehindBundle | None) -> Encoding:
    """Return the encoding with the frequency spread that suits the bundle, where it is left open."""
    if behind is None or not isinstance(encoding, Fourier) or encoding.sigma is not None:
        return encoding
    return replace(encoding, sigma=_PERIODS_PER_PITCH * max(behind.samples.shape) / 2 / behind.samples.pitch)


def _usual_rate(method: TrainedMethod) -> float:
    return _RATE_OF_GRIDS if isinstance(method.encoding, Hash) else _RATE

"""Groupwise registration: scene, motion and gains of all frames solved together, by Gauss-Newton.

Each sensor n, at a fixed place x_n of the frame, has a gain g_n and sees the scene s, seen through its footprint B,
where frame t's transform T_t takes it:

    v_tn = g_n (B s)(T_t x_n) + noise

Every round linearises this in (s, T, g) at once and solves the normal equations by conjugate gradients, with a
membrane prior on the change of s. Moving scene, motion and gains in turn instead takes many times the rounds, because
each hides the errors of the others; the joint round is what finds rotation and perspective from a coarse shift, and
tells a core's gain from the scene behind it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid, Interpolation, blur, roughness

# Residuals beyond this many medians count less (Huber, 1964).
_HUBER = 2.5
# Variance of the gains about 1 that is expected before anything is seen.
_GAIN_VARIANCE = 0.04
_LEAST_DAMPING = 1e-3
_LARGEST_GAIN = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """One level of the way from coarse to fine; lengths in pitches.

    Attributes
    ----------
    spacing : float
        Between the scene's nodes.
    smoothness : float
        Weight of the membrane prior on the change of the scene.
    rounds : int
        At most.
    freedom : int
        Generators that move, at most.
    damping, decay : float
        Levenberg-Marquardt damping of the motion, relative, in the first round, and its factor from round to round.
    """

    spacing: float
    smoothness: float
    rounds: int
    freedom: int = 8
    damping: float = _LEAST_DAMPING
    decay: float = 1.0


# From a coarse shift to within some tenths of a pixel, as far as shift, turn and scale go. The strong damping of the
# first rounds holds back what little is known of before the shifts are right.
COARSE = Level(spacing=0.7, smoothness=3.0, rounds=9, freedom=4, damping=0.2, decay=0.6)
# From there to a tenth, shear and perspective too.
FINER = (
    Level(spacing=0.7, smoothness=1.0, rounds=6, damping=0.1, decay=0.5),
    Level(spacing=0.4, smoothness=0.3, rounds=5),
)
# And to some hundredths, with the sensors' own footprint in the model.
FINE_CORES = (Level(spacing=0.3, smoothness=0.1, rounds=3), Level(spacing=0.22, smoothness=0.03, rounds=2))
FINE_PIXELS = (Level(spacing=0.25, smoothness=0.1, rounds=2), Level(spacing=0.18, smoothness=0.03, rounds=2))
# Rounds end where no frame's centre moves farther than this, pixels.
ENOUGH = 0.015


class Groupwise:
    """The state of a groupwise registration.

    Parameters
    ----------
    positions : Tensor
        (N, 2), where the sensors are, frame pixels.
    values, weights : Tensor
        (T, N) intensities, about 1, and how much each counts; 0 leaves a sample out.
    motion : FrameMotion
        Where to start; moved in place.
    pitch : float
        Unit of the levels' lengths, pixels.
    freedom : int
        Generators of the motion's model.
    sources : Tensor, optional
        (N,) int64: sensors of one number share one gain; default, each has its own.
    gains_fixed : bool
        Leave the gains as they are, where the transmission is known.

    Attributes
    ----------
    scene : Tensor
        (H, W) on `grid`.
    gains : Tensor
        One per source; their median is 1.
    residual : float
        Root of the weighted mean square of what the model leaves, in the last round.
    """

    def __init__(
        self,
        positions: Tensor,
        values: Tensor,
        weights: Tensor,
        motion: FrameMotion,
        pitch: float,
        freedom: int,
        sources: Tensor | None = None,
        gains_fixed: bool = False,
    ) -> None:
        self.positions, self.values, self.weights = positions, values, weights
        self.motion, self.pitch, self.freedom = motion, pitch, freedom
        count = positions.shape[0]
        self._sources = torch.arange(count, device=positions.device) if sources is None else sources
        self._gains_fixed = gains_fixed
        self.gains = torch.ones(int(self._sources.max()) + 1, device=positions.device)
        self.residual = float("nan")
        self.footprint: Footprint | None = None
        points = motion.apply(positions)
        self.grid = Grid.around(points[(weights > 0).any(dim=1)], COARSE.spacing * pitch, 2 * pitch)
        self.scene = splat(self.grid.at(points), values, weights, 1.0 / COARSE.spacing)

    def enter(self, level: Level, radius: float | None = None) -> None:
        """Carry the scene over to a level's grid; `radius` is the sensors' footprint, pixels, None for points."""
        points = self.motion.apply(self.positions[(self.weights > 0).any(dim=0)])[(self.weights > 0).any(dim=1)]
        grid = Grid.around(points, level.spacing * self.pitch, 2 * self.pitch)
        self.scene = self.grid.at(grid.nodes(points.device)).read(self.scene)
        self.grid = grid
        self.footprint = None if radius is None else Footprint(grid, radius, points.device)
        seen = grid.at(self.motion.apply(self.positions)).read(self._through(self.scene))
        self.scene = self.scene * float((self.weights * seen * self.values).sum() / (self.weights * seen**2).sum())

    def take_over(self, other: "Groupwise") -> None:
        """Go on from another registration's scene, of the same frames by other sensors."""
        self.grid, self.scene = other.grid, other.scene

    def round(self, level: Level, number: int) -> float:
        """Do one Gauss-Newton round; return the longest way a frame's centre went, pixels."""
        damping = max(level.damping * level.decay**number, _LEAST_DAMPING)
        system = _Linearised(self, level.smoothness, min(level.freedom, self.freedom), damping)
        scene, steps, _ = system.solve()
        self.residual = system.variance**0.5
        longest = float(self.motion.move(steps).max())
        self.scene = self.scene + scene
        if not self._gains_fixed:
            self._refresh_gains(system.gain_prior)
        return longest

    def settle(self) -> None:
        """Move what the gains have in common into the scene."""
        common = self.gains.median()
        self.gains = self.gains / common
        self.scene = self.scene * common

    def predicted(self) -> Tensor:
        """Return what the model says of `values`, (T, N)."""
        seen = self.grid.at(self.motion.apply(self.positions)).read(self._through(self.scene))
        return seen * self.gains[self._sources]

    def _through(self, scene: Tensor) -> Tensor:
        return scene if self.footprint is None else self.footprint(scene)

    def _per_source(self, values: Tensor) -> Tensor:
        total = torch.zeros_like(self.gains)
        return total.index_add_(0, self._sources, values.sum(dim=0))

    def _refresh_gains(self, prior: float) -> None:
        """Set the best gains for the scene and motion as they are now.

        In the joint step the product of two changes is left out; where a gain is badly known it can be large.
        """
        at = self.grid.at(self.motion.apply(self.positions))
        seen = at.read(self._through(self.scene))
        weights = self.weights * at.inside
        weights = weights * _huber(self.values - self.gains[self._sources] * seen, weights)
        gains = (self._per_source(weights * self.values * seen) + prior) / (self._per_source(weights * seen**2) + prior)
        self.gains = gains.clamp(1 / _LARGEST_GAIN, _LARGEST_GAIN)


class _Linearised:
    """The normal equations of one round, in the changes of scene (H, W), motion (T, k) and gains (G,)."""

    def __init__(self, state: Groupwise, smoothness: float, freedom: int, damping: float) -> None:
        self._state, self._smoothness = state, smoothness
        points = state.motion.apply(state.positions)
        self._at: Interpolation = state.grid.at(points)
        through = state._through(state.scene)
        seen = self._at.read(through)
        self._gain = state.gains[state._sources]
        self._residual = state.values - self._gain * seen
        weights = state.weights * self._at.inside
        self._weights = weights * _huber(self._residual, weights)
        mass = self._weights.sum().clamp_min(1e-12)
        self.variance = float((self._weights * self._residual**2).sum() / mass)
        # With noise of this variance, and gains of theirs about 1, the gains' prior weighs as much as this.
        self.gain_prior = max(self.variance / _GAIN_VARIANCE, 1e-9)
        slope_x, slope_y = self._at.gradient(through)
        along_x, along_y = state.motion.tangent(points, freedom)
        slopes = slope_x.unsqueeze(-1) * along_x + slope_y.unsqueeze(-1) * along_y
        self._slopes = slopes * self._gain.unsqueeze(-1)
        self._seen = seen
        self._prepare(damping)

    def _prepare(self, damping: float) -> None:
        """Set the damping and the preconditioner: the blocks on the diagonal."""
        state = self._state
        weighted = self._slopes * self._weights.unsqueeze(-1)
        blocks = (weighted.mT @ self._slopes).cpu().double()
        sizes = blocks.diagonal(dim1=1, dim2=2)
        floor = sizes * damping + sizes.mean() * 1e-6 + 1e-12
        self._damping = floor.to(self._slopes)
        self._motion_inverse = torch.linalg.inv(blocks + torch.diag_embed(floor)).to(self._slopes)
        self._gain_inverse = 1 / (state._per_source(self._weights * self._seen**2) + self.gain_prior)
        if state._gains_fixed:
            self._gain_inverse = torch.zeros_like(self._gain_inverse)
        node = self._at.write_squares(self._weights * self._gain**2) + 4 * self._smoothness
        self._scene_inverse = 1 / node

    def solve(self, iterations: int = 24) -> tuple[Tensor, Tensor, Tensor]:
        """Return the changes, by preconditioned conjugate gradients."""
        scene, motion, gains = self._adjoint(self._residual)
        right: tuple[Tensor, ...] = (scene, motion, gains - self.gain_prior * (self._state.gains - 1))
        solution = tuple(torch.zeros_like(part) for part in right)
        residual = right
        search = preconditioned = self._precondition(residual)
        power = _inner(residual, preconditioned)
        enough = 1e-4 * float(power)
        for number in range(iterations):
            product = self._multiply(search)
            step = power / _inner(search, product).clamp_min(1e-30)
            solution = tuple(part + step * way for part, way in zip(solution, search, strict=True))
            residual = tuple(part - step * way for part, way in zip(residual, product, strict=True))
            preconditioned = self._precondition(residual)
            before, power = power, _inner(residual, preconditioned)
            if number % 5 == 4 and float(power) <= enough:  # looking makes the host wait for the device
                break
            search = tuple(
                part + power / before.clamp_min(1e-30) * way for part, way in zip(preconditioned, search, strict=True)
            )
        return solution[0], solution[1], solution[2]

    def _multiply(self, parts: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        scene, motion, gains = parts
        seen = self._at.read(self._state._through(scene))
        change = self._gain * seen + (self._slopes @ motion.unsqueeze(-1)).squeeze(-1)
        change = change + self._seen * gains[self._state._sources]
        to_scene, to_motion, to_gains = self._adjoint(change)
        return (
            to_scene + self._smoothness * roughness(scene),
            to_motion + self._damping * motion,
            to_gains + self.gain_prior * gains,
        )

    def _adjoint(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        weighted = self._weights * values
        scene = self._state._through(self._at.write(weighted * self._gain))
        motion = (self._slopes.mT @ weighted.unsqueeze(-1)).squeeze(-1)
        return scene, motion, self._state._per_source(weighted * self._seen)

    def _precondition(self, parts: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        scene, motion, gains = parts
        moved = (self._motion_inverse @ motion.unsqueeze(-1)).squeeze(-1)
        return scene * self._scene_inverse, moved, gains * self._gain_inverse


def splat(at: Interpolation, values: Tensor, weights: Tensor, sigma: float) -> Tensor:
    """Return the local mean (H, W) of scattered values, over a Gaussian of `sigma` nodes and wider where none is."""
    total = torch.stack([at.write(values * weights), at.write(weights)])
    near = blur(total, sigma)
    far = blur(near, 3 * sigma)
    everywhere = total[0].sum() / total[1].sum().clamp_min(1e-12)
    faint = 1e-3 * near[1].mean() + 1e-12
    filled = (far[0] + faint * everywhere) / (far[1] + faint)
    return (near[0] + faint * filled) / (near[1] + faint)


def _huber(residual: Tensor, weights: Tensor) -> Tensor:
    """Return the weights of Huber's loss, its threshold set by the median of the residuals that count."""
    sizes = residual.abs()
    counted = sizes[weights > 0]
    threshold = _HUBER * counted.median() if counted.numel() else sizes.new_tensor(1.0)
    return (threshold / sizes.clamp_min(1e-9)).clamp(max=1)


def _inner(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> Tensor:
    return torch.stack([(a * b).sum() for a, b in zip(first, second, strict=True)]).sum()

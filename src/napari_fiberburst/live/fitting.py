"""The place of a frame, fitted to the scene as it stands."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.live.compiled import compiled
from napari_fiberburst.live.cores import Cores
from napari_fiberburst.live.memory import Memory
from napari_fiberburst.live.pose import Pose

Floats = NDArray[np.float32]

# At most so many iterations of Gauss-Newton on every so many-th core, whose medians serve, and then on all.
_FIRST, _LAST, _EVERY = 3, 3, 4
# Residuals beyond so many times their median count less (Huber).
_ROBUST = 3.0
# Pixels: a step that moves no corner farther ends the first iterations, and the last ones.
_NEARLY_SETTLED, _SETTLED = 0.05, 0.01
# A core that looks at nodes which have been seen with this weight counts half, because the scene is not settled there;
# in a scene that few cores have looked at all count, because it would be held where they did.
_ENOUGH_SEEN, _YOUNG_SEEN = 3.0, 1e-3
# Of the unknowns: shift x and y, zoom, turn, brightness.
_UNKNOWNS = 5


@dataclass(frozen=True, slots=True)
class Fit:
    """How a frame lies on the scene.

    Attributes
    ----------
    pose : Pose
        Where.
    brightness : float
        Of the frame, relative to the scene.
    alike : float
        Correlation of the cores' light with what the scene has there, 0 to 1.
    """

    pose: Pose
    brightness: float
    alike: float


class Fitter:
    """Fits pose and brightness of frames to the scene as cores see it, by Gauss-Newton.

    Parameters
    ----------
    cores : Cores
        Of the frames.
    """

    def __init__(self, cores: Cores) -> None:
        self._all, self._some = cores, cores.every(_EVERY)

    def __call__(self, grey: Floats, weights: Floats, scene: Floats, memory: Memory, pose: Pose, *, turns: bool) -> Fit:
        """Return how a frame lies.

        Parameters
        ----------
        grey, weights : numpy.ndarray
            (N,), what its cores show.
        scene : numpy.ndarray
            (rows, columns), the scene on the nodes of the memory.
        memory : Memory
            It knows how much each node has been seen.
        pose : Pose
            Where to start.
        turns : bool
            Whether the frame may have turned and grown since; otherwise it is only shifted.
        """
        found = Fit(pose, 0.0, 0.0)
        for step, iterations, enough in ((_EVERY, _FIRST, _NEARLY_SETTLED), (1, _LAST, _SETTLED)):
            cores = self._all if step == 1 else self._some
            shown, counting = (np.ascontiguousarray(part[::step]) for part in (grey, weights))
            for _ in range(iterations):
                before = found.pose
                found = _improved(found, cores, shown, counting, scene, memory, _EVERY // step, turns=turns)
                if _farthest(before, found.pose) < enough:
                    break
        return found


def _improved(
    fit: Fit, cores: Cores, shown: Floats, weights: Floats, scene: Floats, memory: Memory, every: int, *, turns: bool
) -> Fit:
    """Return a fit after another iteration, and how alike frame and scene were before."""
    pose, nodes, brightness = fit.pose, memory.nodes, fit.brightness
    looked, normal = np.empty((4, len(shown)), np.float32), np.zeros((_UNKNOWNS, _UNKNOWNS + 1))
    enough = np.float32((_ENOUGH_SEEN if turns else _YOUNG_SEEN) * memory.growth)
    _look(cores.x, cores.y, *nodes.under(pose), scene, memory.seen, enough, weights, looked)
    light, weight = looked[0], looked[3]
    if not brightness:
        *_, both, power = _moments(shown, light, weight)
        brightness = both / max(power, 1e-9)
    left = np.abs(shown[::every] - np.float32(brightness) * light[::every])[weight[::every] > 0]
    limit = _ROBUST * (float(np.median(left)) + 1e-6 if left.size else np.inf)
    turn, per_node = pose.turn, brightness / nodes.spacing
    _gather(cores.x, cores.y, turn.real, turn.imag, shown, looked, brightness, per_node, limit, normal)
    sums = _moments(shown, light, weight)
    if not sums[0] > 0:
        return Fit(pose, 1.0, 0.0)
    change = _solved(normal, turns)
    moved = pose.moved(complex(change[0], change[1]), 1 + complex(change[2], change[3]))
    return Fit(moved, brightness + float(change[4]), _correlation(*sums))


def _farthest(first: Pose, second: Pose) -> float:
    """Return how far apart two poses have a corner, at most about, pixels."""
    return max(abs(second.place - first.place), abs(second.turn - first.turn) * abs(first.middle))


@compiled("void(f4[::1], f4[::1], f8, f8, f8, f8, f4[:,::1], f4[:,::1], f4, f4[::1], f4[:,::1])")
def _look(
    x: Floats,
    y: Floats,
    u: Any,
    v: Any,
    a: Any,
    b: Any,
    scene: Floats,
    seen: Floats,
    enough: Any,
    weights: Floats,
    looked: Floats,
) -> None:
    """Put what the scene has at cores into `looked`: light, slopes along x and y per node, weight; 0 where unseen."""
    rows, columns = scene.shape
    nodes, counts = scene.reshape(-1), seen.reshape(-1)
    light, slope_x, slope_y, weight = looked[0], looked[1], looked[2], looked[3]
    one, step = np.uint64(1), np.uint64(columns)  # without a sign there are no negative indices to look after
    u, v, a, b = np.float32(u), np.float32(v), np.float32(a), np.float32(b)
    for core in range(len(x)):
        across, down = u + a * x[core] - b * y[core], v + b * x[core] + a * y[core]
        if not (0 <= across < columns - 1 and 0 <= down < rows - 1):
            light[core] = slope_x[core] = slope_y[core] = weight[core] = 0
            continue
        i, j = np.int32(down), np.int32(across)
        right, below = across - np.float32(j), down - np.float32(i)
        left, above = np.float32(1) - right, np.float32(1) - below
        first = np.uint64(i) * step + np.uint64(j)
        p, q, r, s = nodes[first], nodes[first + one], nodes[first + step], nodes[first + step + one]
        top, bottom = p * left + q * right, r * left + s * right
        light[core] = top * above + bottom * below
        slope_x[core] = (q - p) * above + (s - r) * below
        slope_y[core] = bottom - top
        # A sample in this cell has given weight to all four nodes.
        seen_here = counts[first] + counts[first + step + one]
        weight[core] = weights[core] * seen_here / (seen_here + enough)


@compiled("void(f4[::1], f4[::1], f4, f4, f4[::1], f4[:,::1], f4, f4, f4, f8[:,::1])")
def _gather(
    x: Floats,
    y: Floats,
    cosine: Any,
    sine: Any,
    shown: Floats,
    looked: Floats,
    brightness: Any,
    per_node: Any,
    limit: Any,
    normal: NDArray[np.float64],
) -> None:
    """Put the normal equations of Gauss-Newton into `normal`, (5, 5) and the right-hand side beside them.

    Residuals beyond `limit` take weight from what was looked at.
    """
    light, slope_x, slope_y, weight = looked[0], looked[1], looked[2], looked[3]
    aa = ab = ac = ad = ae = al = np.float32(0)
    bb = bc = bd = be = bl = np.float32(0)
    cc = cd = ce = cl = np.float32(0)
    dd = de = dl = np.float32(0)
    ee = el = np.float32(0)
    for core in range(len(x)):
        left = shown[core] - brightness * light[core]
        count = weight[core] / max(np.float32(1), abs(left) / limit)
        weight[core] = count
        turned_x, turned_y = cosine * x[core] - sine * y[core], sine * x[core] + cosine * y[core]
        a, b, e = slope_x[core] * per_node, slope_y[core] * per_node, light[core]
        c, d = a * turned_x + b * turned_y, b * turned_x - a * turned_y
        wa, wb, wc, wd, we = count * a, count * b, count * c, count * d, count * e
        aa += wa * a
        ab += wa * b
        ac += wa * c
        ad += wa * d
        ae += wa * e
        al += wa * left
        bb += wb * b
        bc += wb * c
        bd += wb * d
        be += wb * e
        bl += wb * left
        cc += wc * c
        cd += wc * d
        ce += wc * e
        cl += wc * left
        dd += wd * d
        de += wd * e
        dl += wd * left
        ee += we * e
        el += we * left
    sums = ((aa, ab, ac, ad, ae, al), (ab, bb, bc, bd, be, bl), (ac, bc, cc, cd, ce, cl), (ad, bd, cd, dd, de, dl))
    for row in range(4):
        for column in range(6):
            normal[row, column] = sums[row][column]
    for column, total in enumerate((ae, be, ce, de, ee, el)):
        normal[4, column] = total


def _solved(normal: NDArray[np.float64], turns: bool) -> NDArray[np.float64]:
    """Return the step that solves normal equations (5, 6); without zoom and turn where there are none."""
    if not turns:
        normal[2:4] = normal[:, 2:4] = 0
    matrix, right_hand = normal[:, :_UNKNOWNS], normal[:, _UNKNOWNS]
    scale = np.sqrt(matrix.diagonal()) + 1e-12
    damped = matrix / np.outer(scale, scale) + 1e-6 * np.eye(_UNKNOWNS)
    change: NDArray[np.float64] = np.linalg.solve(damped, right_hand / scale) / scale
    return change


@compiled("UniTuple(f8, 6)(f4[::1], f4[::1], f4[::1])")
def _moments(first: Floats, second: Floats, weight: Floats) -> Any:
    """Return the weighted sums of 1, a, b, a a, a b and b b of two images."""
    n = a = b = aa = ab = bb = 0.0
    for core in range(len(first)):
        wa, wb = weight[core] * first[core], weight[core] * second[core]
        n += weight[core]
        a += wa
        b += wb
        aa += wa * first[core]
        ab += wa * second[core]
        bb += wb * second[core]
    return n, a, b, aa, ab, bb


def _correlation(n: float, a: float, b: float, aa: float, ab: float, bb: float) -> float:
    power = (aa - a * a / n) * (bb - b * b / n)
    return max(0.0, (ab - a * b / n) / math.sqrt(power)) if power > 0 else 0.0

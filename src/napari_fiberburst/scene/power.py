"""The power spectrum of a scene, from what two images of it have in common."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

# Knots of the logarithm of the power over that of the frequency, from the lowest to the highest.
_KNOTS = 9
# By how much the slope between knots usually changes from one to the next; natural scenes follow a power law.
_SLOPE_CHANGE = 1.5
# A spectrum that rises with frequency is a mistake: so much less than 1 is what a slope of 1 is worth.
_RISE = 0.1
_ROUNDS = 3
# Rings that are missed by more than this many times their error count less and less.
_ODD = 3.0
_LEAST_TRANSFER = 1e-6
# What is passed by more than this tells where to start from.
_WELL_PASSED = 0.2


def fit_power(
    frequency: NDArray[np.float64],
    cross: NDArray[np.float64],
    noise: NDArray[np.float64],
    count: NDArray[np.float64],
    transfer: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the power of a scene over rings of its spectrum, (F,).

    It falls, and its logarithm is piecewise linear over that of the frequency, with slopes that change little: where
    hardly anything is passed, it goes on as it fell before. A cross spectrum scatters about what is passed of the power
    by sqrt(((t p)^2 + (t p + n)^2) / 2 m) over m frequencies (Bendat and Piersol, "Random data", 2010, chapter 9), so
    rings below that count, too, and negative ones as they are: to take positive ones alone makes power of noise.

    Parameters
    ----------
    frequency : numpy.ndarray
        (F,) rising, above 0.
    cross, noise, count : numpy.ndarray
        (F,) as `RingSpectra` has them.
    transfer : numpy.ndarray
        (F,) t, what part of the power is in the cross spectrum.
    """
    at = np.log(frequency)
    knots = np.linspace(at[0], at[-1], _KNOTS)
    basis = np.stack([np.interp(at, knots, unit) for unit in np.eye(_KNOTS)], axis=1)
    passed = np.maximum(transfer, 0)
    tells = passed > _LEAST_TRANSFER
    error = np.sqrt((cross**2 + (np.abs(cross) + noise) ** 2) / (2 * count)) + np.finfo(float).tiny
    logarithm = _start(at, knots, cross, passed)
    for _ in range(_ROUNDS):

        def missed(logarithm: NDArray[np.float64], error: NDArray[np.float64] = error) -> NDArray[np.float64]:
            power, slopes = np.exp(np.clip(basis @ logarithm, -700, 700)), np.diff(logarithm) / np.diff(knots)
            rings = ((cross - passed * power) / error)[tells]
            return np.concatenate([rings, np.diff(slopes) / _SLOPE_CHANGE, np.maximum(slopes, 0) / _RISE])

        logarithm = least_squares(missed, logarithm, max_nfev=30, loss="soft_l1", f_scale=_ODD).x
        seen = passed * np.exp(np.clip(basis @ logarithm, -700, 700))
        error = np.sqrt((seen**2 + (seen + noise) ** 2) / (2 * count)) + np.finfo(float).tiny
    return np.asarray(np.exp(np.clip(basis @ logarithm, -700, 700)))


def _start(
    at: NDArray[np.float64], knots: NDArray[np.float64], cross: NDArray[np.float64], passed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a power law through what is passed well."""
    clear = (cross > 0) & (passed > _WELL_PASSED)
    if clear.sum() < 3:
        return np.asarray(np.log(max(float(cross[0]), np.finfo(float).tiny)) - 3 * (knots - knots[0]))
    slope, level = np.polyfit(at[clear], np.log(cross[clear] / passed[clear]), 1)
    return np.asarray(min(slope, -1.0) * knots + level)

"""Images against the truth, modulo what a bundle leaves undetermined: one gain and offset per channel."""

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import peak_signal_noise_ratio, structural_similarity


def match_levels(image: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the image with the gain and offset per channel that bring it closest to the truth.

    A bundle dims the scene by its transmission, so only what is left after one gain and offset tells of quality.

    Parameters
    ----------
    image, truth : numpy.ndarray
        (H, W) or (H, W, C), of one shape.

    Returns
    -------
    numpy.ndarray
        float64, of the same shape, in the truth's units.
    """
    if image.shape != truth.shape:
        raise ValueError(f"image and truth must have one shape; got {image.shape} and {truth.shape}")
    channels = image.shape[2] if image.ndim == 3 else 1
    given, wanted = (np.asarray(array, np.float64).reshape(-1, channels) for array in (image, truth))
    centred = given - given.mean(axis=0)
    power = (centred**2).mean(axis=0)
    gain = np.divide((centred * wanted).mean(axis=0), power, out=np.zeros(channels), where=power > 0)
    matched: NDArray[np.float64] = (wanted.mean(axis=0) + gain * centred).reshape(image.shape)
    return matched


def psnr(image: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Return the peak signal-to-noise ratio in dB, after `match_levels`; the truth's full scale is 1."""
    matched = match_levels(image, truth)
    return float(peak_signal_noise_ratio(np.asarray(truth, np.float64), matched, data_range=1))


def ssim(image: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Return scikit-image's structural similarity, after `match_levels`; the truth's full scale is 1."""
    matched = match_levels(image, truth)
    channel_axis = 2 if truth.ndim == 3 else None
    return float(structural_similarity(np.asarray(truth, np.float64), matched, data_range=1, channel_axis=channel_axis))

"""How good an image and a motion are, where the truth is known."""

from napari_fiberburst.quality.image import match_levels, psnr, ssim
from napari_fiberburst.quality.motion import motion_error
from napari_fiberburst.quality.resolution import RingCorrelation, ring_correlation

__all__ = ["RingCorrelation", "match_levels", "motion_error", "psnr", "ring_correlation", "ssim"]

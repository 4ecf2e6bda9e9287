"""How good a picture and a motion are, where the truth is known."""

from napari_fiberburst.quality.motion import motion_error
from napari_fiberburst.quality.picture import match_levels, psnr, ssim

__all__ = ["match_levels", "motion_error", "psnr", "ssim"]

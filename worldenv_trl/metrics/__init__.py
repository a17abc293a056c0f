"""Success with intervals, video fidelity, reflector quality, honesty of imagination."""

from worldenv_trl.metrics.classification import Classification, classification
from worldenv_trl.metrics.honesty import honesty
from worldenv_trl.metrics.success import paired_test, wilson_interval
from worldenv_trl.metrics.video import moving_pixel_psnr, psnr, ssim

__all__ = [
    "Classification",
    "classification",
    "honesty",
    "moving_pixel_psnr",
    "paired_test",
    "psnr",
    "ssim",
    "wilson_interval",
]

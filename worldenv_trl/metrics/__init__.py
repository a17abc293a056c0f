"""Success with intervals, video fidelity, reflector quality, honesty of imagination."""

from worldenv_trl.metrics.alarm import HonestyAlarm
from worldenv_trl.metrics.classification import Classification, classification
from worldenv_trl.metrics.drift import drift
from worldenv_trl.metrics.honesty import advantage_correlation, honesty, rank_correlation
from worldenv_trl.metrics.success import paired_test, wilson_interval
from worldenv_trl.metrics.video import moving_pixel_psnr, psnr, ssim

__all__ = [
    "Classification",
    "HonestyAlarm",
    "advantage_correlation",
    "classification",
    "drift",
    "honesty",
    "moving_pixel_psnr",
    "paired_test",
    "psnr",
    "rank_correlation",
    "ssim",
    "wilson_interval",
]

"""Success with intervals, video fidelity, the quality of scores and stops, honesty of imagination."""

from worldenv_trl.metrics.alarm import HonestyAlarm
from worldenv_trl.metrics.classification import Classification, classification
from worldenv_trl.metrics.drift import drift
from worldenv_trl.metrics.honesty import advantage_correlation, honesty, rank_correlation
from worldenv_trl.metrics.stopping import choose_rule, first_success, frame_figures, judged, stop_figures
from worldenv_trl.metrics.success import paired_test, wilson_interval
from worldenv_trl.metrics.video import moving_pixel_psnr, psnr, ssim

__all__ = [
    "Classification",
    "HonestyAlarm",
    "advantage_correlation",
    "choose_rule",
    "classification",
    "drift",
    "first_success",
    "frame_figures",
    "honesty",
    "judged",
    "moving_pixel_psnr",
    "paired_test",
    "psnr",
    "rank_correlation",
    "ssim",
    "stop_figures",
    "wilson_interval",
]

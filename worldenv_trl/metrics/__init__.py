"""Success with intervals, video fidelity, the quality of scores and stops, honesty of imagination."""

from worldenv_trl.metrics.agreement import cohen_kappa, precision, recall
from worldenv_trl.metrics.alarm import HonestyAlarm
from worldenv_trl.metrics.calibration import calibration_slope, expected_calibration_error
from worldenv_trl.metrics.classification import Classification, classification
from worldenv_trl.metrics.drift import drift
from worldenv_trl.metrics.frechet import frechet_distance, load_video_features, video_features
from worldenv_trl.metrics.groups import Estimate, group_bootstrap, group_correlations, group_slope
from worldenv_trl.metrics.honesty import advantage_correlation, honesty, rank_correlation
from worldenv_trl.metrics.perceptual import LPIPS
from worldenv_trl.metrics.stopping import (
    choose_rule,
    first_success,
    frame_figures,
    judged,
    largest_scores,
    loop_returns,
    stop_figures,
)
from worldenv_trl.metrics.success import paired_test, wilson_interval
from worldenv_trl.metrics.video import moving_pixel_psnr, psnr, ssim

__all__ = [
    "LPIPS",
    "Classification",
    "Estimate",
    "HonestyAlarm",
    "advantage_correlation",
    "calibration_slope",
    "choose_rule",
    "classification",
    "cohen_kappa",
    "drift",
    "expected_calibration_error",
    "first_success",
    "frame_figures",
    "frechet_distance",
    "group_bootstrap",
    "group_correlations",
    "group_slope",
    "honesty",
    "judged",
    "largest_scores",
    "load_video_features",
    "loop_returns",
    "moving_pixel_psnr",
    "paired_test",
    "precision",
    "psnr",
    "rank_correlation",
    "recall",
    "ssim",
    "stop_figures",
    "video_features",
    "wilson_interval",
]

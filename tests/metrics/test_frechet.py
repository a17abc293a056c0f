"""The Fréchet distance against closed forms and SciPy's matrix root; extractors of features from files."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import torch

from worldenv_trl.metrics import frechet_distance, load_video_features, video_features


def with_moments(mean, covariance, count, seed=0) -> torch.Tensor:
    """Rows [count, D] whose mean and covariance are exactly these."""
    noise = np.random.default_rng(seed).normal(size=(count, len(mean)))
    noise -= noise.mean(0)
    noise = np.linalg.solve(np.linalg.cholesky(np.cov(noise, rowvar=False)), noise.T).T
    return torch.from_numpy(noise @ np.linalg.cholesky(covariance).T + mean)


def test_gaussians_of_known_moments():
    # Commuting covariances: the distance is |m1 - m2|^2 plus the squared differences of the deviations.
    first = with_moments([1.0, 2.0, 3.0], np.diag([4.0, 9.0, 1.0]), 50)
    second = with_moments([1.0, 0.0, 6.0], np.diag([1.0, 9.0, 16.0]), 70, seed=1)
    assert frechet_distance(first, second) == pytest.approx(0 + 4 + 9 + (2 - 1) ** 2 + 0 + (1 - 4) ** 2)
    assert frechet_distance(first, first) == pytest.approx(0, abs=1e-9)


def test_covariances_that_do_not_commute_against_scipys_root():
    rng = np.random.default_rng(3)
    factors = rng.normal(size=(2, 5, 5))
    covariances = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(5)
    means = rng.normal(size=(2, 5))
    root = scipy.linalg.sqrtm(covariances[0] @ covariances[1]).real
    expected = ((means[0] - means[1]) ** 2).sum() + np.trace(covariances[0] + covariances[1] - 2 * root)
    features = [with_moments(means[side], covariances[side], 40, seed=side) for side in (0, 1)]
    assert frechet_distance(*features) == pytest.approx(expected, rel=1e-8)
    assert frechet_distance(*features[::-1]) == pytest.approx(expected, rel=1e-8)


def test_fewer_rows_than_numbers_still_give_a_distance():
    one, other = torch.randn(6, 40), torch.randn(8, 40)
    covariances = [np.cov(each.double().numpy(), rowvar=False) for each in (one, other)]
    values = np.linalg.eigvals(covariances[0] @ covariances[1]).astype(complex)  # of rank 5: roots of rounding are left
    expected = (one.mean(0) - other.mean(0)).square().sum().item() + sum(np.trace(each) for each in covariances)
    expected -= 2 * np.sqrt(values[values.real > 1e-6]).real.sum()
    assert frechet_distance(one, other) == pytest.approx(expected, rel=1e-4)
    assert frechet_distance(one, one) == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize(
    ("one", "other", "said"),
    [
        (torch.zeros(1, 3), torch.zeros(4, 3), r"generated features must be \[n, D\] of at least 2 rows, got \[1, 3\]"),
        (torch.zeros(4, 3), torch.zeros(4, 2), "equally wide, got 3 and 2"),
        (torch.zeros(4, 3), torch.full((4, 3), torch.nan), "real features are not finite"),
    ],
)
def test_features_that_do_not_suit_are_refused(one, other, said):
    with pytest.raises(ValueError, match=said):
        frechet_distance(one, other)


class Means(torch.nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.mean((3, 4)).flatten(1)


class Detector(torch.nn.Module):
    """Takes what the common I3D file takes: it must not be told to rescale or resize, and be asked for features."""

    def forward(
        self, x: torch.Tensor, rescale: bool = True, resize: bool = True, return_features: bool = False
    ) -> torch.Tensor:
        means = x.mean((3, 4)).flatten(1)
        return means if return_features and not rescale and not resize else means[:, :1] * 0


def test_videos_come_as_i3d_wants_them():
    videos = torch.randint(0, 256, (3, 10, 3, 20, 24), dtype=torch.uint8)
    shapes = []

    def extractor(x):
        shapes.append(tuple(x.shape))
        return x.mean((3, 4)).flatten(1)

    found = video_features(extractor, videos, rows_at_once=2)
    assert shapes == [(2, 3, 10, 224, 224), (1, 3, 10, 224, 224)]
    expected = (videos.float().mean((3, 4)) / 255 * 2 - 1).transpose(1, 2).flatten(1)  # by channel, then frame
    assert torch.allclose(found, expected, atol=0.02)  # resizing weighs borders a little otherwise


@pytest.mark.parametrize("kind", [Means, Detector])
@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
def test_extractors_are_read_from_torchscript(tmp_path, kind):
    torch.jit.script(kind()).save(str(tmp_path / "i3d.pt"))
    videos = torch.randint(0, 256, (2, 12, 3, 16, 16), dtype=torch.uint8)
    found = video_features(load_video_features(tmp_path / "i3d.pt"), videos)
    assert torch.allclose(found, video_features(Means(), videos)) and found.shape == (2, 36)


def test_what_cannot_be_used_is_said_in_a_line(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file .*i3d\.pt: FVD needs .*i3d_torchscript\.pt of https"):
        load_video_features(tmp_path / "i3d.pt")
    (tmp_path / "i3d.pt").write_text("no")
    with pytest.raises(ValueError, match=r"i3d\.pt is no TorchScript file"):
        load_video_features(tmp_path / "i3d.pt")
    with pytest.raises(ValueError, match="at least 10 frames"):
        video_features(Means(), torch.zeros(2, 9, 3, 16, 16, dtype=torch.uint8))
    with pytest.raises(ValueError, match=r"must give \[2, D\], got \[\]"):
        video_features(lambda x: x.mean(), torch.zeros(2, 10, 3, 16, 16, dtype=torch.uint8))

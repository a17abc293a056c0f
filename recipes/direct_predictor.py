"""Success told without video, from the first frames, the task and where the hand goes: what imagination must beat."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import trange

from worldenv_trl.data import Episodes, predicted_poses
from worldenv_trl.keys import ACTION_DIM, POSE_DIM, TASK_ID
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.metrics import first_success
from worldenv_trl.policies import random_shift

_ROWS_AT_ONCE = 256


class DirectPredictor(nn.Module):
    """Log-odds of success from keypoints of the first frames and convolutions over the path.

    Keypoints are expected coordinates under a spatial softmax (Finn et al., ICRA 2016).

    Args:
        cameras: whose first frames it sees.
        tasks: how many there are.

    Keyword Args:
        keypoints: on the image.
        width: of the convolutions over time.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, cameras: int, tasks: int, *, keypoints: int = 32, width: int = 64) -> None:
        super().__init__()
        self.maps = nn.Sequential(
            nn.Conv2d(3 * cameras, 32, 5, stride=2, padding=2), nn.GELU(),
            nn.Conv2d(32, 32, 3, stride=2, padding=1), nn.GELU(),
            nn.Conv2d(32, keypoints, 3, padding=1),
        )  # fmt: skip
        self.scene, self.task = nn.Linear(2 * keypoints, width), nn.Embedding(tasks, width)
        self.path = nn.Conv1d(POSE_DIM + ACTION_DIM, width, 5, padding=2)
        self.later = nn.Sequential(
            nn.Conv1d(width, width, 5, stride=2, padding=2), nn.GELU(),
            nn.Conv1d(width, width, 5, stride=2, padding=2), nn.GELU(),
        )  # fmt: skip
        self.head = nn.Linear(2 * width, 1)
        self.register_buffer("mean", torch.zeros(POSE_DIM + ACTION_DIM))
        self.register_buffer("std", torch.ones(POSE_DIM + ACTION_DIM))

    def forward(self, images: Tensor, path: Tensor, task: Tensor) -> Tensor:
        """Log-odds [n].

        Args:
            images: uint8 [n, 3 V, H, W], the first frames of V cameras.
            path: [n, T, 20], pose after and action of every step.
            task: int64 [n].
        """
        maps = self.maps(images.float() / 127.5 - 1)
        height, width = maps.shape[-2:]
        weight = maps.flatten(2).softmax(-1).unflatten(-1, (height, width))
        rows, columns = torch.linspace(-1, 1, height), torch.linspace(-1, 1, width)
        points = torch.cat([(weight.sum(-1) * rows).sum(-1), (weight.sum(-2) * columns).sum(-1)], -1)
        known = self.scene(points) + self.task(task)  # [n, width]
        steps = self.path(((path - self.mean) / self.std).transpose(1, 2)) + known.unsqueeze(-1)
        steps = self.later(F.gelu(steps))
        return self.head(torch.cat([steps.mean(-1), steps.amax(-1)], -1)).squeeze(-1)


def fit_direct(
    episodes: Episodes, kinematics: ForwardKinematics, tasks: int, *, steps: int = 1500, batch_size: int = 64
) -> DirectPredictor:
    """Trains on labelled episodes, with images shifted by up to 2 px; draws from torch's generator.

    Raises:
        ValueError: for episodes without labels.
    """
    if "success" not in episodes:
        raise ValueError("the episodes carry no success labels: there is nothing to predict")
    images, path, task = _seen(episodes, kinematics)
    label = (first_success(episodes["success"]) >= 0).float()
    model = DirectPredictor(len(episodes.cameras), tasks)
    model.mean.copy_(path.mean((0, 1)))
    model.std.copy_(path.std((0, 1)).clamp_min(1e-3))
    optimizer = torch.optim.AdamW(model.parameters(), weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=1e-3, total_steps=steps)
    for _ in trange(steps, desc="direct predictor", unit="step"):
        rows = torch.randint(len(label), (batch_size,))
        logits = model(random_shift(images[rows], 2), path[rows], task[rows])
        loss = F.binary_cross_entropy_with_logits(logits, label[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return model.eval()


@torch.no_grad()
def predict_direct(model: DirectPredictor, episodes: Episodes, kinematics: ForwardKinematics) -> Tensor:
    """Probability of success of each of R episodes, [R]."""
    parts = zip(*(values.split(_ROWS_AT_ONCE) for values in _seen(episodes, kinematics)), strict=True)
    return torch.cat([model(*part).sigmoid() for part in parts])


def _seen(episodes: Episodes, kinematics: ForwardKinematics) -> tuple[Tensor, Tensor, Tensor]:
    """First frames [R, 3 V, H, W], path [R, T, 20] and task [R]: what a world model is conditioned on."""
    rows = torch.arange(len(episodes))
    images = torch.cat([episodes.frames(camera, rows, torch.zeros_like(rows)) for camera in episodes.cameras], 1)
    path = torch.cat([predicted_poses(episodes, kinematics)[:, 1:], episodes["actions"]], -1)
    return images, path, episodes[TASK_ID].squeeze(-1)

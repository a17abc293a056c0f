"""Where on the first frame the hand comes down and where the goal is reached, and how a hand lies relative to that."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from worldenv_trl.kinematics.calibrations import Calibrations
from worldenv_trl.kinematics.densities import log_density
from worldenv_trl.kinematics.planes import plane
from worldenv_trl.reflectors.goal import Goal

__all__ = ["KINDS", "Places", "offsets", "places_of"]

KINDS = 2  # where the hand comes down, where it is when the goal is reached
_WAVELENGTHS = (0.24, 0.12, 0.06)  # m
_NEAR, _FAR = 0.05, 4.0  # m that count as one, and how many at most
_FALLEN, _STOPPED = 0.03, 0.01  # m below where it began; fall from a look to the next
_WIDTH = 0.7  # standard deviation of what a map is taught, in cells
_AROUND = 3  # cells beside the likeliest that a place is the mean of: four such deviations


class Places(nn.Module):
    """Heat maps of the first frame, one for each keypoint or place, and the points of the table that they mean.

    A map is what a policy's aim is (:class:`~worldenv_trl.objectives.AimedCloning`; Transporter networks,
    arXiv:2010.14406), taught by rollouts that succeed: noise of the hand averages out, so a map finds a bowl to a
    millimetre from places that lie a centimetre beside it.

    Args:
        views: of each of the V cameras.
        image_size: height and width of the frames (px).
        instructions: those that heights are kept for.
        num_words: of the vocabulary.
        width: channels.
    """

    height: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self,
        views: Sequence[Calibrations],
        image_size: int,
        instructions: Sequence[str],
        num_words: int,
        width: int = 32,
    ) -> None:
        super().__init__()
        self._views, self.image_size, self.side = list(views), image_size, -(-image_size // 2)
        self._number = {text: number for number, text in enumerate(instructions)}
        self.eyes = nn.ModuleList(_Eye(num_words, width, self.side) for _ in views)
        self.register_buffer("height", torch.zeros(len(instructions), KINDS))  # m
        self.register_buffer("low", torch.full((2,), -1.0))  # m: where a hand has been
        self.register_buffer("high", torch.ones(2))

    def forward(self, first: Tensor, view: Tensor, words: Tensor, levels: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probabilities of the maps' cells, and the points that they mean.

        Args:
            first: uint8 [n, V, 3, H, W], the first frames.
            view: int64 [n, V], which calibration of each camera.
            words: int64 [n, W].
            levels: [n, K] (m), see :meth:`levels`.

        Returns:
            [n, V, K, P] and [n, V * K, 2] (m): where the rays of the cells around the likeliest meet the places'
            level, on average.
        """
        maps = torch.stack([eye(first[:, index], words) for index, eye in enumerate(self.eyes)], 1)
        chances = _peaks(maps, self.side)
        points = []
        for index, known in enumerate(self._views):
            met = chances.new_zeros(len(first), KINDS, self.side**2, 2)
            for number, camera in enumerate(known.distinct):
                rows = (view[:, index] == number).nonzero().squeeze(-1)
                table = plane(camera, (self.side, self.side), levels[rows].flatten())[..., :2]
                met[rows] = table.reshape(len(rows), KINDS, -1, 2)
            met = torch.minimum(torch.maximum(met, self.low), self.high)
            points.append(torch.einsum("nkp,nkpc->nkc", chances[:, index], met))
        return maps, torch.cat(points, 1)

    def levels(self, texts: Sequence[str]) -> Tensor:
        """How high hands are at the places of n instructions, [n, K] (m); the mean of all where that is not known."""
        table = torch.cat([self.height, self.height.mean(0, keepdim=True)])
        return table[[self._number.get(text, len(self.height)) for text in texts]]

    def fit(self, points: Tensor, reached: Tensor, texts: Sequence[str], hands: Tensor) -> None:
        """Takes heights from the places [R, K, 3] (m) of episodes that reach the goal, ``reached`` bool [R] with one at
        least, and bounds from all hands [R, L, 3] (m)."""
        flat = hands[..., :2].flatten(0, -2)
        self.low.copy_(flat.amin(0))
        self.high.copy_(flat.amax(0))
        rows_of: dict[str, list[int]] = {text: [] for text in self._number}
        for row in reached.nonzero().squeeze(-1).tolist():
            rows_of[texts[row]].append(row)
        everywhere = points[reached][..., 2].median(0).values
        for text, rows in rows_of.items():
            self.height[self._number[text]] = points[rows][..., 2].median(0).values if rows else everywhere

    def divergence(self, maps: Tensor, seen: Tensor) -> Tensor:
        """KL(target, map), nats [n, V, K], of log-probabilities [n, V, K, P] from densities around where places are
        ``seen``, [n, V, K, 2] (px)."""
        target = log_density(seen * (self.side / self.image_size), self.side, _WIDTH)
        return (target.exp() * (target - maps)).sum(-1)


def places_of(hands: Tensor, reached: Tensor) -> Tensor:
    """Where each hand comes down, on the way to the goal if it is reached, and where it is when it is, [R, K, 3].

    Args:
        hands: [R, L, 3] (m), at each look.
        reached: bool [R, L], whether the goal is reached by then.
    """
    rows = torch.arange(len(hands), device=hands.device)
    end = torch.where(reached.any(1), reached.long().argmax(1), reached.shape[1] - 1)
    return torch.stack([hands[rows, torch.minimum(_landings(hands), end)], hands[rows, end]], 1)


def _landings(hands: Tensor) -> Tensor:
    """The look at which each hand of [R, L, 3] (m) comes down, int64 [R]; L if it does not.

    It has come down where it first stops to fall, 3 cm or more below where it began: a look later that is known.
    """
    height = hands[..., 2]
    fall = height - torch.cat([height[:, 1:], height[:, -1:]], 1)
    down = (height[:, :1] - height > _FALLEN) & (fall < _STOPPED)
    return torch.where(down.any(1), down.long().argmax(1), hands.shape[1])


def offsets(hands: Tensor, points: Tensor) -> Tensor:
    """How hands [n, L, 3] lie relative to points [n, Q, 2] of the table, [n, L, F].

    Two millimetres decide whether a hand takes hold, and are a fiftieth of how far hands go: told as numbers of that
    size they hardly reach what a network says. On sines and cosines they do. (Fourier features, arXiv:2006.10739.)
    """
    apart = (hands[:, :, None, :2] - points[:, None]).flatten(2)  # [n, L, 2 Q]
    told, where = [(apart / _NEAR).clamp(-_FAR, _FAR)], torch.cat([apart, hands[..., 2:]], -1)
    for wavelength in _WAVELENGTHS:
        phase = 2 * math.pi / wavelength * where
        told += [phase.sin(), phase.cos()]
    return torch.cat(told, -1)


def _peaks(maps: Tensor, side: int) -> Tensor:
    """Log-probabilities [..., P] as those of the cells around the likeliest alone, [..., P] (a local soft-argmax's
    weights): a tenth that is left over on the other side of the table would move the mean by centimetres."""
    cells, mode = torch.arange(maps.shape[-1], device=maps.device), maps.argmax(-1, keepdim=True)
    apart = torch.maximum((cells // side - mode // side).abs(), (cells % side - mode % side).abs())
    return maps.masked_fill(apart > _AROUND, -math.inf).softmax(-1)


class _Eye(nn.Module):
    """One camera's frames to log-probabilities [n, K, P] of half as many cells a side.

    Where the hand lets go of a drawer that it has opened there is nothing but table: what tells of it is the cabinet,
    a third of the picture away. So the convolutions are dilated (arXiv:1511.07122) until each cell is told of half the
    picture.
    """

    def __init__(self, num_words: int, width: int, side: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3, width, 5, stride=2, padding=2), nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1), nn.GELU(),
        )  # fmt: skip
        self.goal = Goal(num_words, 16, width, scale=1.0)
        dilations = [2**power for power in range(max(1, side // 4).bit_length())]
        self.wider = nn.ModuleList(nn.Conv2d(width, width, 3, padding=each, dilation=each) for each in dilations)
        self.maps = nn.Conv2d(width, KINDS, 1)

    def forward(self, frames: Tensor, words: Tensor) -> Tensor:
        seen = self.stem(frames.float() / 255 - 0.5) + self.goal(words)[..., None, None]
        for layer in self.wider:
            seen = seen + F.gelu(layer(seen))
        return self.maps(seen).flatten(2).log_softmax(-1)

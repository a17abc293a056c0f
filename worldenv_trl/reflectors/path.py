"""A reflector of paths: whether where the hand goes reaches the goal in the scene that the first frame shows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from worldenv_trl.keys import KINEMATIC_STATES, POSE_DIM
from worldenv_trl.kinematics import ActionMap, ForwardKinematics
from worldenv_trl.kinematics.calibrations import Calibrations, check_instructions, plain_cameras
from worldenv_trl.language import Vocabulary
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.reflectors.base import Lesson, Reflector
from worldenv_trl.reflectors.goal import MAX_WORDS, Goal
from worldenv_trl.reflectors.path_lessons import PathLessons, lessons_of
from worldenv_trl.reflectors.places import KINDS, Places, offsets
from worldenv_trl.robot.camera import Camera

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes

__all__ = ["PathReflector", "PathReflectorConfig"]

_DILATIONS = (1, 2, 4, 8)
_CROPS_AT_ONCE = 512
_DEFAULT_LESSONS = PathLessons()


@dataclass(frozen=True)
class PathReflectorConfig:
    """Cameras and sizes of a :class:`PathReflector`.

    Args:
        cameras: camera name -> instruction -> :class:`~worldenv_trl.robot.camera.Camera`, as plain values; see
            :meth:`for_cameras`. They are fixed in the world.
        image_size: height and width of the frames (px).
        window: side of what is seen around the hand, in shares of the frame's.
        crop_size: pixels (px) that this window is resampled to.
        stride: frames from one look to the next.
        feature_dim: length of what is seen at a look.
        width: channels of the convolutions over time.
        dropout: while learning.
        members: networks whose probabilities are averaged.

    Raises:
        ValueError: for no camera, one that moves, or sizes out of range.
    """

    cameras: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    image_size: int = 64
    window: float = 0.28
    crop_size: int = 18
    stride: int = 2
    feature_dim: int = 32
    width: int = 96
    dropout: float = 0.2
    members: int = 2

    def __post_init__(self) -> None:
        check_instructions(self.cameras, "PathReflectorConfig")
        moving = [
            name for name, each in self.cameras.items() if any(Camera(**view).mount == "tool" for view in each.values())
        ]
        if moving:
            raise ValueError(
                f"the camera {moving[0]!r} moves with the hand: the first frame does not show where it goes. Name "
                "cameras that are fixed in the world"
            )
        if min(self.stride, self.feature_dim, self.width, self.members) < 1 or self.crop_size < 8:
            raise ValueError(
                "stride, feature_dim, width and members must be at least 1 and crop_size at least 8, got "
                f"{self.stride}, {self.feature_dim}, {self.width}, {self.members} and {self.crop_size}"
            )
        if not 0 < self.window <= 1 or not 0 <= self.dropout < 1:
            raise ValueError(f"window must be in (0, 1] and dropout in [0, 1), got {self.window} and {self.dropout}")

    @classmethod
    def for_cameras(cls, cameras: Mapping[str, Mapping[str, Camera]], **settings: Any) -> PathReflectorConfig:
        """Config for ``{camera name: {instruction: camera}}``: what each instruction's scene is seen through."""
        return cls(cameras=plain_cameras(cameras), **settings)

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> PathReflectorConfig:
        return cls(**fields)

    @property
    def instructions(self) -> tuple[str, ...]:
        """Those that it has cameras for."""
        return tuple(next(iter(self.cameras.values()), {}))


class PathReflector(Reflector, Pretrained):
    """R(o_1, s_1:t, g): the probability that the goal is reached by t, of the first frame and the commanded path alone.

    On the first frame it finds where hands that succeed come down, and where they are when the goal is reached, and
    how this hand lies relative to both (:mod:`~worldenv_trl.reflectors.places`). Every ``stride`` frames it also looks
    at the first frame around the point where the hand is then: what will be under the fingers was seen sharply once,
    before the hand covered it. Causal convolutions over all of this and the hand's poses, and mean and maximum of what
    they say so far, give R of every prefix. It learns from real rollouts which path fails in which scene, and reads
    nothing that a world model paints, so ghosts of success cannot mislead it; what happens otherwise than commanded it
    does not see either. Where noise alone makes paths fail it learns to call smoothness success, wherever the hand
    goes: it wants greedy rollouts that fail, too.

    A hand that sees the world answers to what happens there: it goes back for what it missed, or it goes on. R of real
    rollouts reads that, too, and in a dream, where a hand goes on whatever it did, there is nothing to be read (causal
    confusion, arXiv:1905.11979).

    A hand view is what others predict as a second camera (Ctrl-World, 2510.10125); success told for every frame is the
    reward head of World-VLA-Loop (2602.06508).

    Args:
        config: cameras and sizes.
        lessons: how long it learns in :meth:`train_on`; not saved.

    Examples:
        >>> from worldenv_trl.envs import TabletopEnv
        >>> env = TabletopEnv("starter/open_the_top_drawer", 2, seed=0)
        >>> text = env.tasks[0].language
        >>> config = PathReflectorConfig.for_cameras({"agentview": {text: env.tasks[0].camera("agentview")}})
        >>> reflector, rollout = PathReflector(config), env.rollout(4)
        >>> first = {"agentview": rollout["observation", "image"][:, 0]}
        >>> state = reflector.begin(first | {"kinematic_states": rollout["kinematic_state"][:, 0]}, [text] * 2)
        >>> video = {"agentview": rollout["next", "observation", "image"]}
        >>> state, scores = reflector.extend(state, video | {"kinematic_states": rollout["next", "kinematic_state"]})
        >>> scores.shape
        torch.Size([2, 4])
    """

    config_class = PathReflectorConfig

    mean: Tensor
    std: Tensor

    def __init__(self, config: PathReflectorConfig, lessons: PathLessons = _DEFAULT_LESSONS) -> None:
        super().__init__(
            cameras=tuple(config.cameras),
            image_size=config.image_size,
            instructions=config.instructions,
            reads_path=True,
            reads_video=False,
        )
        self.config, self.lessons = config, lessons
        self.vocabulary = Vocabulary(Vocabulary.of(config.instructions), MAX_WORDS)
        self._views = [Calibrations(by_text) for by_text in config.cameras.values()]
        self._maps = nn.ModuleList(ActionMap(view.distinct, config.image_size) for view in self._views)
        num_words = len(self.vocabulary.words)
        self.places = Places(self._views, config.image_size, config.instructions, num_words)
        self.members = nn.ModuleList(_Member(config, num_words) for _ in range(config.members))
        self.register_buffer("mean", torch.zeros(2 * POSE_DIM))
        self.register_buffer("std", torch.ones(2 * POSE_DIM))

    # ------------------------------------------------------------------------------------------------- judging

    @torch.no_grad()
    def begin(self, frames: Mapping[str, Tensor], instructions: Sequence[str]) -> TensorDict:
        self.seen.check(instructions)
        poses = ForwardKinematics.commanded_pose(frames[KINEMATIC_STATES]).unsqueeze(1)
        state = TensorDict(batch_size=[len(poses)], device=poses.device)
        state["first"] = torch.stack([self._checked(frames, camera) for camera in self.cameras], 1)
        state["view"] = self.views_of(instructions).to(poses.device)
        state["words"] = self.vocabulary.ids(instructions, poses.device)
        levels = self.places.levels(instructions)
        state["places"] = self.places(state["first"], state["view"], state["words"], levels)[1]
        state["poses"], state["seen"] = poses, torch.ones(len(poses), dtype=torch.int64, device=poses.device)
        crops = self.crops(state["first"], state["view"], poses)
        state["looks"] = self.look(crops)
        state["score"] = self._scores(state, torch.zeros_like(state["seen"]).unsqueeze(-1)).squeeze(-1)
        return state

    @torch.no_grad()
    def extend(self, state: TensorDictBase, frames: Mapping[str, Tensor]) -> tuple[TensorDict, Tensor]:
        new = ForwardKinematics.commanded_pose(frames[KINEMATIC_STATES])  # [n, C, 13]
        rows = torch.arange(len(new), device=new.device).unsqueeze(-1)
        place = state["seen"].unsqueeze(-1) + torch.arange(new.shape[1], device=new.device)
        crops = self.crops(state["first"], state["view"], new)
        looks = self.look(crops)
        grown = TensorDict(dict(state.items()), batch_size=state.batch_size, device=state.device)
        for name, values in (("poses", new), ("looks", looks)):
            known = state[name]
            needed = max(known.shape[1], int(place.max()) + 1)
            whole = values.new_zeros(len(values), needed, *values.shape[2:])
            whole[:, : known.shape[1]] = known
            whole[rows, place] = values
            grown[name] = whole
        scores = self._scores(grown, place)
        grown["seen"], grown["score"] = state["seen"] + new.shape[1], scores[:, -1].clone()
        return grown, scores

    def _checked(self, frames: Mapping[str, Tensor], camera: str) -> Tensor:
        size = (3, self.config.image_size, self.config.image_size)
        if camera not in frames:
            raise ValueError(f"the reflector looks at {camera!r}, the frames are of {', '.join(frames)}")
        if tuple(frames[camera].shape[1:]) != size:
            raise ValueError(
                f"frames of {camera!r} must be [n, 3, {size[1]}, {size[2]}], got {list(frames[camera].shape)}"
            )
        return frames[camera]

    def _scores(self, state: TensorDictBase, place: Tensor) -> Tensor:
        """R after the frames ``place`` [n, C]: that of the last look up to each."""
        stride = self.config.stride
        path = self.path(state["poses"][:, ::stride], state["places"])
        logits = self.logits(state["looks"][:, ::stride], path, state["words"])
        return logits.sigmoid().mean(2).gather(1, place // stride)

    def moves(self, poses: Tensor) -> Tensor:
        """Poses [n, L, 13], one at each look, and how they changed, normalised: [n, L, 26]."""
        change = torch.cat([torch.zeros_like(poses[:, :1]), poses.diff(dim=1)], 1)
        return (torch.cat([poses, change], -1) - self.mean) / self.std

    def path(self, poses: Tensor, places: Tensor) -> Tensor:
        """What the networks are told of poses [n, L, 13] and places [n, Q, 2]: moves and offsets, [n, L, 26 + F]."""
        return torch.cat([self.moves(poses), offsets(poses[..., :3], places)], -1)

    def views_of(self, instructions: Sequence[str]) -> Tensor:
        """Which calibration of each camera the n instructions' scenes are seen through, int64 [n, V], on the CPU."""
        return torch.stack([view.indices(instructions) for view in self._views], 1)

    def pixels(self, points: Tensor, view: Tensor) -> Tensor:
        """Where points [n, L, 3] (m) are seen, [n, V, L, 2] (px), through the calibrations ``view`` int64 [n, V]."""
        each = view.unsqueeze(-1).expand(*view.shape, points.shape[1]).unbind(1)
        seen = [cast(ActionMap, drawn).project(points, index) for drawn, index in zip(self._maps, each, strict=True)]
        return torch.stack(seen, 1)

    def crops(self, first: Tensor, view: Tensor, poses: Tensor) -> Tensor:
        """The first frames around where the hand is, resampled.

        Args:
            first: uint8 [n, V, 3, H, W], of the V cameras.
            view: int64 [n, V], which calibration of each camera.
            poses: [n, L, 13].

        Returns:
            Floats [n, L, 3 * V, S, S] in [-.5, .5]; past the frame's edge its last pixels are repeated.
        """
        looks, size, side = poses.shape[1], self.config.crop_size, self.config.image_size
        steps = torch.linspace(-1, 1, size, device=poses.device) * self.config.window
        around = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1)  # [S, S, (x, y)]
        seen = []
        for index, pixels in enumerate(self.pixels(poses[..., :3], view).unbind(1)):
            grid = (2 * pixels / side - 1)[:, :, None, None] + around  # [n, L, S, S, 2]
            image = first[:, index].float() / 255 - 0.5
            crop = F.grid_sample(image, grid.flatten(1, 2), align_corners=False, padding_mode="border")
            seen.append(crop.unflatten(2, (looks, size)).transpose(1, 2))
        return torch.cat(seen, 2)

    def look(self, crops: Tensor) -> Tensor:
        """What each member sees, [n, L, M, F], of crops [n, L, 3 * V, S, S]."""
        return torch.stack([cast(_Member, member).look(crops) for member in self.members], 2)

    def logits(self, looks: Tensor, path: Tensor, words: Tensor) -> Tensor:
        """Log-odds [P, L, M] of every prefix and member: that the goal is reached by then.

        Args:
            looks: [P, L, M, F], what the members saw at each look.
            path: [P, L, 26 + F], see :meth:`path`.
            words: int64 [P, W].
        """
        each = [member(looks[:, :, index], path, words) for index, member in enumerate(self.members)]
        return torch.stack(each, 2)

    # ------------------------------------------------------------------------------------------------- learning

    def train_on(self, episodes: Episodes) -> Iterator[Lesson]:
        """Two lessons: ``places``, from the first frames of episodes that succeed, none if no episode does; then
        ``paths``, from whole episodes, every task equally often, labelled at every look. There the hand lies 3 mm
        (normal, one draw an episode) beside where it was: in the physics that hardly changes how an episode ends.

        Outcomes are drawn as often as they occur, so that R is a probability.

        Raises:
            ValueError: for episodes without labels, of other cameras or sizes, or of an instruction that the config
                does not name.
        """
        return lessons_of(self, episodes)

    def training_loss(self, batch: TensorDictBase) -> TensorDict:
        """Of paths the binary cross-entropy of "reached by then", mean over episodes of the mean over looks plus that
        of the last. Of places the divergence of the maps from what they are taught.

        Args:
            batch: [P] of one lesson. Of ``paths``: ``crops`` floats [P, L, 3 V, S, S], ``path`` [P, L, 26 + F],
                ``words`` int64 [P, W], ``label`` bool [P, L], ``weight`` [P, L]: 1 up to the episode's end, 0 behind
                it. Of ``places``: ``first`` uint8 [P, V, 3, H, W], ``view`` int64 [P, V], ``words``, ``levels`` [P, K]
                (m) and ``place`` [P, K, 3] (m).
        """
        if "place" in batch.keys():  # noqa: SIM118
            return self._places_loss(batch)
        label, weight = batch["label"].float(), batch["weight"]
        logits = self.logits(self.look(batch["crops"]), batch["path"], batch["words"])
        each = F.binary_cross_entropy_with_logits(logits, label.unsqueeze(-1).expand_as(logits), reduction="none")
        last = (weight.sum(1).long() - 1).clamp(min=0)
        rows = torch.arange(len(last), device=last.device)
        whole = (each * weight.unsqueeze(-1)).sum(1) / weight.sum(1, keepdim=True)
        loss = (whole + each[rows, last]).mean(0).sum()  # members learn on their own
        decides = logits[rows, last].detach().sigmoid().mean(-1)
        right = (decides > 0.5) == (label[rows, last] > 0.5)
        return TensorDict({"loss_reflector": loss, "accuracy": right.float().mean()})

    def _places_loss(self, batch: TensorDictBase) -> TensorDict:
        place, view = batch["place"], batch["view"]
        maps, points = self.places(batch["first"], view, batch["words"], batch["levels"])
        loss = self.places.divergence(maps, self.pixels(place, view)).mean(0).sum()
        away = (points.detach().unflatten(1, (-1, KINDS)) - place[:, None, :, :2]).norm(dim=-1)
        return TensorDict({"loss_reflector": loss, "accuracy": (away < 0.02).float().mean()})


class _Member(nn.Module):
    """One network: crops and path to the log-odds of every prefix."""

    def __init__(self, config: PathReflectorConfig, num_words: int) -> None:
        super().__init__()
        cells, width = -(-config.crop_size // 8), config.width
        self.eye = nn.Sequential(
            nn.Conv2d(3 * len(config.cameras), 24, 5, stride=2, padding=2), nn.GELU(),
            nn.Conv2d(24, 32, 3, stride=2, padding=1), nn.GELU(),
            nn.Conv2d(32, 32, 3, stride=2, padding=1), nn.GELU(),
            nn.Flatten(), nn.Dropout(config.dropout), nn.Linear(32 * cells**2, config.feature_dim),
        )  # fmt: skip
        self.goal = Goal(num_words, 16, width, scale=1.0)
        apart = offsets(torch.zeros(1, 1, 3), torch.zeros(1, KINDS * len(config.cameras), 2)).shape[-1]
        self.into = nn.Linear(config.feature_dim + 2 * POSE_DIM + apart, width)
        self.over_time = nn.ModuleList(_Causal(width, dilation, config.dropout) for dilation in _DILATIONS)
        self.head = nn.Sequential(nn.Dropout(config.dropout), nn.Linear(3 * width, 1))

    def look(self, crops: Tensor) -> Tensor:
        """Features [P, L, F] of crops [P, L, 3 V, S, S]."""
        flat = crops.flatten(0, 1)
        whole = torch.is_grad_enabled() or flat.device.type != "cpu"
        parts = [flat] if whole else flat.split(_CROPS_AT_ONCE)  # what fits a CPU's cache is faster
        return torch.cat([self.eye(part) for part in parts]).unflatten(0, crops.shape[:2])

    def forward(self, looks: Tensor, path: Tensor, words: Tensor) -> Tensor:
        hidden = self.into(torch.cat([looks, path], -1)) + self.goal(words).unsqueeze(1)
        for layer in self.over_time:
            hidden = hidden + layer(hidden)
        count = torch.arange(1, hidden.shape[1] + 1, device=hidden.device).unsqueeze(-1)
        so_far = [hidden, hidden.cumsum(1) / count, hidden.cummax(1).values]
        return self.head(torch.cat(so_far, -1)).squeeze(-1)


class _Causal(nn.Module):
    """A residual branch over [P, L, W] that looks two dilated steps back."""

    def __init__(self, width: int, dilation: int, dropout: float) -> None:
        super().__init__()
        self.reach = 2 * dilation
        self.norm = nn.LayerNorm(width)
        self.conv = nn.Conv1d(width, width, 3, dilation=dilation)
        self.out = nn.Sequential(nn.GELU(), nn.Dropout(dropout), nn.Linear(width, width))

    def forward(self, hidden: Tensor) -> Tensor:
        before = F.pad(F.gelu(self.norm(hidden)).transpose(1, 2), (self.reach, 0))
        return self.out(self.conv(before).transpose(1, 2))

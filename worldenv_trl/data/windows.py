"""Training windows of the world model: what it remembers at a step, what the hand will do, what will be seen."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer, TensorStorage
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import ImmutableDatasetWriter

from worldenv_trl.data.episodes import Episodes
from worldenv_trl.devices import device_of, to_device
from worldenv_trl.keys import FRAMES, INSTRUCTION, TASK_ID
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.row_share import own_rows
from worldenv_trl.row_texts import row_texts
from worldenv_trl.world_models import WorldModel

__all__ = ["WindowBuffer", "WindowSampler", "predicted_poses", "window_buffer"]


@torch.no_grad()
def predicted_poses(episodes: Episodes, kinematics: ForwardKinematics) -> Tensor:
    """Poses [R, T + 1, 13] of the hand, predicted open loop from each episode's first kinematic state and its actions.

    These, not the measured ones, condition the world model: in imagination there is nothing to measure (World-Env
    section 3.2). Past the end of an episode the hand holds still. Predicted on the device of ``kinematics``, given on
    the CPU.
    """
    device = device_of(kinematics)
    first = episodes["kinematic_states"][:, 0].to(device)
    after = kinematics.rollout(first, episodes["actions"].to(device))
    return kinematics.pose(torch.cat([first.unsqueeze(1), after], 1)).cpu()


class WindowSampler(Sampler):
    """Draws windows of the episodes, every frame that leaves room for a chunk being as likely a start as any other.

    A model that sees successes far more often than failures paints a success whenever it is in doubt, and a policy that
    learns in it looks for the doubt. With a ``failure_share`` the tasks are drawn equally often, and that share of each
    task's windows comes from episodes that never reach the goal.

    Only a window that starts at the reset shows the first frame being left, while imagination starts there every time:
    a share of the windows starts there on purpose.

    Args:
        episodes: at least one executed step.
        world_model: says which frames it remembers, and its chunk length.

    Keyword Args:
        chunks: consecutive chunks in a window.
        reset_share: share of windows that start at an episode's first frame; default: one decision in eight.
        failure_share: see above; None draws from all episodes alike.
        seed: of the draws; from torch's generator when None.

    Raises:
        ValueError: for episodes without a step, or without the labels that a ``failure_share`` needs; for settings out
            of range.
    """

    def __init__(
        self,
        episodes: Episodes,
        world_model: WorldModel,
        *,
        chunks: int = 2,
        reset_share: float = 0.125,
        failure_share: float | None = None,
        seed: int | None = None,
    ) -> None:
        if chunks < 1:
            raise ValueError(f"chunks must be at least 1, got {chunks}")
        if not 0 <= reset_share <= 1:
            raise ValueError(f"reset_share must lie between 0 and 1, got {reset_share}")
        if failure_share is not None and not 0 <= failure_share <= 1:
            raise ValueError(f"failure_share must lie between 0 and 1, got {failure_share}")
        if failure_share is not None and "success" not in episodes:
            raise ValueError("the episodes carry no success labels: failure_share must be None")
        length = episodes["length"].squeeze(-1)
        if not len(episodes) or not bool(length.any()):
            raise ValueError(f"the {len(episodes)} episodes hold no executed step: there is no window to draw")
        self.chunks, self.reset_share = chunks, reset_share
        self._length, self._first = length, episodes.video[1]
        self._memory_indices, self.chunk_length = world_model.memory_indices, world_model.chunk_length
        self._starts = ((length - self.chunk_length).clamp(min=0) + 1) * (length > 0)  # [R]
        self._weights = _window_weights(episodes, self._starts, failure_share)
        self._generator = torch.Generator()
        self._generator.manual_seed(int(torch.randint(2**31, ()).item()) if seed is None else seed)

    def __len__(self) -> int:
        """Distinct windows."""
        return int(self._starts.sum())

    def sample(self, storage: Any, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Frames int64 [B, K] of ``batch_size`` windows, and what they are: ``episode`` and ``start`` [B], ``number``
        [B, K], the frames' numbers in their episode (past its end they show its last frame)."""

        def episodes(count: int) -> Tensor:
            return torch.multinomial(self._weights, count, replacement=True, generator=self._generator)

        def uniform(count: int) -> Tensor:
            return torch.rand(count, generator=self._generator)

        episode, place = own_rows(episodes, batch_size), own_rows(uniform, batch_size)
        at_reset = own_rows(uniform, batch_size) < self.reset_share
        start = torch.minimum((place * self._starts[episode]).long(), self._starts[episode] - 1)
        start = start.masked_fill(at_reset, 0)
        return self.window(episode, start)

    def window(self, episode: Tensor, start: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The windows that begin after frame ``start`` [B] of ``episode`` [B]; see :meth:`sample`.

        Raises:
            ValueError: for a start outside its episode.
        """
        length = self._length[episode]
        outside = (start < 0) | (start > length)
        if bool(outside.any()):
            row = int(outside.nonzero()[0])
            raise ValueError(
                f"a window starts at frame {int(start[row])} of episode {int(episode[row])}, which has frames 0 to "
                f"{int(length[row])}"
            )
        steps = torch.arange(1, self.chunks * self.chunk_length + 1)
        remembered = [self._memory_indices(start + chunk * self.chunk_length) for chunk in range(self.chunks)]
        first = torch.zeros_like(start).unsqueeze(-1)  # the reference
        number = torch.cat([first, *remembered, start.unsqueeze(-1) + steps], 1)
        index = self._first[episode].unsqueeze(-1) + torch.minimum(number, length.unsqueeze(-1))
        return index, {"episode": episode, "start": start, "number": number}

    def state_dict(self) -> dict[str, Any]:
        """The random state."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._generator.set_state(state_dict["generator"])

    def _empty(self) -> None:
        pass

    def dumps(self, path: Any) -> None:
        """Nothing is kept on disk: :meth:`state_dict` holds the random state."""

    def loads(self, path: Any) -> None:
        """See :meth:`dumps`."""


class WindowBuffer(ReplayBuffer):
    """A ReplayBuffer whose samples are training windows; see :func:`window_buffer`."""

    def __init__(
        self, episodes: Episodes, poses: Tensor, sampler: WindowSampler, batch_size: int, device: torch.device
    ) -> None:
        frames, _ = episodes.video
        super().__init__(
            storage=TensorStorage(frames),
            sampler=sampler,
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
        )
        self._episodes, self._poses, self._device = episodes, poses, device

    def sample(self, batch_size: int | None = None, return_info: bool = False) -> Any:
        """Windows [B]; see :func:`window_buffer`."""
        frames, info = super().sample(batch_size, return_info=True)
        windows = to_device(self.windows(frames, info), self._device)
        self._episodes.reading.add(frames.bytes(), self._episodes.video[0])
        return (windows, info) if return_info else windows

    def state_dict(self) -> dict[str, Any]:
        """Where its draws are; the frames are not part of it: nobody writes to them."""
        return {"sampler": self._sampler.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._sampler.load_state_dict(state_dict["sampler"])

    def windows(self, frames: TensorDictBase, info: dict[str, Tensor]) -> TensorDict:
        """Frames [B, K] and what they are, as windows [B]."""
        episodes, episode, number = self._episodes, info["episode"], info["number"]
        length = episodes["length"][episode]  # [B, 1]
        step = number[:, -self._sampler.chunks * self._sampler.chunk_length :] - 1  # [B, n C]
        inside = step < length
        actions, row = episodes["actions"], episode.unsqueeze(-1)
        out = TensorDict(
            {
                FRAMES: frames[FRAMES],
                "poses": self._poses[row, torch.minimum(number, length)],
                "number": number,
                "start": info["start"].unsqueeze(-1),
                "actions": actions[row, step.clamp(max=actions.shape[1] - 1)] * inside.unsqueeze(-1),
                "step_mask": inside,
            },
            batch_size=[len(episode)],
        )
        out.set(INSTRUCTION, row_texts([episodes.instructions[index] for index in episode.tolist()]))
        return out


def window_buffer(
    episodes: Episodes,
    kinematics: ForwardKinematics,
    world_model: WorldModel,
    *,
    batch_size: int = 8,
    **options: Any,
) -> WindowBuffer:
    """A ReplayBuffer over the episodes' frames that draws windows to train ``world_model`` on.

    A sample is a TensorDict [B] as :class:`~worldenv_trl.world_models.Window` reads it: ``("frames", entry)`` uint8
    [B, K, 3, H, W] of each camera, ``poses`` [B, K, 13] predicted by forward kinematics, ``number`` int64 [B, K],
    ``start`` int64 [B, 1], ``actions`` [B, n C, 7], ``step_mask`` bool [B, n C] and ``language_instruction``. Samples
    are drawn on the CPU, where the frames are, and go to the device of ``world_model``.

    Args:
        episodes: of one store; its frames may be on disk.
        kinematics: FK(s, a); poses are predicted once, here.
        world_model: the model to train.

    Keyword Args:
        batch_size: B.
        options: of :class:`WindowSampler`.

    Raises:
        ValueError: for cameras or frames that are not the model's, episodes without a step, or settings out of range.

    Examples:
        >>> from worldenv_trl.data import episodes_from_rollouts
        >>> from worldenv_trl.envs import TabletopEnv
        >>> from worldenv_trl.objectives import WorldModelLoss
        >>> from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig
        >>> env = TabletopEnv("starter/open_the_top_drawer", 2, seed=0)
        >>> seen_by = {"agentview": {task.language: task.camera("agentview") for task in env.tasks}}
        >>> model = VideoWorldModel(VideoWorldModelConfig.for_cameras(seen_by, width=16))
        >>> episodes = episodes_from_rollouts(env.rollout(12))
        >>> windows = window_buffer(episodes, ForwardKinematics(), model, batch_size=2, chunks=1).sample()
        >>> windows["frames", "image"].shape, windows["actions"].shape  # remembered and asked for; executed
        (torch.Size([2, 12, 3, 64, 64]), torch.Size([2, 8, 7]))
        >>> WorldModelLoss(model)(windows)["loss_world_model"].backward()
    """
    episodes.require("the world model", world_model.cameras, world_model.image_size)
    episodes = episodes.through(world_model.cameras)
    sampler = WindowSampler(episodes, world_model, **options)
    poses = predicted_poses(episodes, kinematics)
    return WindowBuffer(episodes, poses, sampler, batch_size, device_of(world_model))


def _window_weights(episodes: Episodes, starts: Tensor, failure_share: float | None) -> Tensor:
    """How often each episode is drawn ``[R]``: by its windows, within its task and outcome."""
    weights = starts.double()
    if failure_share is None:
        return weights
    task, failed = episodes[TASK_ID].squeeze(-1), ~episodes["success"].any(-1)
    shared = torch.zeros_like(weights)
    for number in task.unique():
        for outcome, share in ((True, failure_share), (False, 1 - failure_share)):
            rows = (task == number) & (failed == outcome)
            shared[rows] = share * weights[rows] / weights[rows].sum().clamp_min(1)
        shared[task == number] /= shared[task == number].sum().clamp_min(1e-9)  # one outcome may be missing
    return shared if shared.any() else weights

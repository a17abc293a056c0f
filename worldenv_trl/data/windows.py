"""Training windows of the world model: what it remembers at a step, what the hand will do, what will be seen."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.keys import ACTION_DIM, TASK_ID
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.world_models import VideoWorldModel

__all__ = ["WindowSampler", "predicted_poses", "world_model_windows"]

_PADDED_ACTION_DIM = 14  # the world model's dual-arm interface; a single arm fills the first seven


@torch.no_grad()
def predicted_poses(episodes: TensorDictBase, kinematics: ForwardKinematics) -> Tensor:
    """Poses [R, T + 1, 13] of the hand, predicted open loop from each episode's first kinematic state and its actions.

    These, not the measured ones, condition the world model: in imagination there is nothing to measure (World-Env
    section 3.2). Past the end of an episode the hand holds still.
    """
    first = episodes["kinematic_states"][:, 0]
    after = kinematics.rollout(first, episodes["actions"])
    return kinematics.pose(torch.cat([first.unsqueeze(1), after], 1))


def world_model_windows(
    episodes: TensorDictBase,
    poses: Tensor,
    world_model: VideoWorldModel,
    episode: Tensor,
    start: Tensor,
    *,
    chunks: int = 2,
) -> TensorDict:
    """The windows of ``chunks`` consecutive chunks that begin at the given frames: the input of ``DiffusionLoss``.

    Args:
        episodes: TensorDict [R], see :func:`~worldenv_trl.data.episodes_from_rollouts`.
        poses: [R, T + 1, 13], see :func:`predicted_poses`.
        world_model: its ``memory_indices`` says which frames are remembered, its ``chunk_length`` is C.
        episode: int64 [B], which episode.
        start: int64 [B], the frame t after which the window begins; 0 is the reset.

    Returns a TensorDict [B]: ``("memory", "frames")`` uint8 [B, M, 3, H, W], ``("memory", "poses")`` [B, M, 13],
    ``("memory", "reference")`` uint8 [B, 3, H, W] (the episode's first frame), ``poses`` [B, n C, 13],
    ``padded_actions`` [B, n C, 14], ``target_frames`` uint8 [B, n C, 3, H, W], ``target_mask`` bool [B, n C] (False
    past the end of the episode, where the last frame repeats) and ``task_id`` [B, 1].

    Raises:
        ValueError: for a start outside its episode.
    """
    length = episodes["length"][episode].squeeze(-1)  # [B]
    outside = (start < 0) | (start > length)
    if bool(outside.any()):
        row = int(outside.nonzero()[0])
        raise ValueError(
            f"a window starts at frame {int(start[row])} of episode {int(episode[row])}, which has frames 0 to "
            f"{int(length[row])}"
        )
    rows = episode.unsqueeze(-1)
    memory = world_model.memory_indices(start)
    step = start.unsqueeze(-1) + torch.arange(chunks * world_model.chunk_length, device=start.device)  # [B, n C]
    end = length.unsqueeze(-1)
    seen = torch.minimum(step + 1, end)
    inside = step < end
    actions = episodes["actions"][rows, step.clamp(max=episodes["actions"].shape[1] - 1)] * inside.unsqueeze(-1)
    frames = episodes["frames"]
    return TensorDict(
        {
            "memory": {
                "frames": frames[rows, memory],
                "poses": poses[rows, memory],
                "reference": frames[episode, 0],
            },
            "poses": poses[rows, seen],
            "padded_actions": torch.nn.functional.pad(actions, (0, _PADDED_ACTION_DIM - ACTION_DIM)),
            "target_frames": frames[rows, seen],
            "target_mask": inside,
            TASK_ID: episodes[TASK_ID][episode],
        },
        batch_size=[len(episode)],
        device=frames.device,
    )


class WindowSampler:
    """Draws windows of the episodes, every frame that leaves room for a chunk being as likely a start as any other.

    A model that sees successes far more often than failures paints a success whenever it is in doubt, and a policy that
    learns in it looks for the doubt. With a ``failure_share`` the tasks are drawn equally often, and that share of each
    task's windows comes from episodes that never reach the goal.

    Only a window that starts at the reset shows the first frame being left, while imagination starts there every time:
    a share of the windows starts there on purpose.

    Args:
        episodes: TensorDict [R] of at least one executed step.
        kinematics: FK(s, a); poses are predicted once, here.
        world_model: the model to train.

    Keyword Args:
        chunks: consecutive chunks in a window.
        reset_share: share of windows that start at an episode's first frame; default: one decision in eight.
        failure_share: see above; None draws from all episodes alike.
        seed: of the draws; from torch's generator when None.

    Raises:
        ValueError: for episodes without a step, frames of another size than the model's, or settings out of range.
    """

    def __init__(
        self,
        episodes: TensorDictBase,
        kinematics: ForwardKinematics,
        world_model: VideoWorldModel,
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
        length = episodes["length"].squeeze(-1)
        if not len(episodes) or not bool(length.any()):
            raise ValueError(f"the {len(episodes)} episodes hold no executed step: there is no window to draw")
        size, frames = world_model.config.image_size, episodes["frames"]
        if tuple(frames.shape[2:]) != (3, size, size):
            raise ValueError(f"the world model sees {size} px images, the episodes' are {tuple(frames.shape[2:])}")
        self.episodes, self.world_model = episodes, world_model
        self.chunks, self.reset_share = chunks, reset_share
        self.poses = predicted_poses(episodes, kinematics)
        self._starts = ((length - world_model.chunk_length).clamp(min=0) + 1) * (length > 0)  # [R]
        self._weights = _window_weights(episodes, self._starts, failure_share)
        self._generator = torch.Generator()
        self._generator.manual_seed(int(torch.randint(2**31, ()).item()) if seed is None else seed)

    def __len__(self) -> int:
        """Distinct windows."""
        return int(self._starts.sum())

    def sample(self, batch_size: int) -> TensorDict:
        """``batch_size`` windows, with replacement; see :func:`world_model_windows`."""
        episode = torch.multinomial(self._weights, batch_size, replacement=True, generator=self._generator)
        place = torch.rand(batch_size, generator=self._generator)
        at_reset = torch.rand(batch_size, generator=self._generator) < self.reset_share
        episode, place, at_reset = (value.to(self._starts.device) for value in (episode, place, at_reset))
        start = torch.minimum((place * self._starts[episode]).long(), self._starts[episode] - 1)
        start = start.masked_fill(at_reset, 0)
        return world_model_windows(self.episodes, self.poses, self.world_model, episode, start, chunks=self.chunks)


def _window_weights(episodes: TensorDictBase, starts: Tensor, failure_share: float | None) -> Tensor:
    """How often each episode is drawn ``[R]``, on the CPU: by its windows, within its task and outcome."""
    weights = starts.double().cpu()
    if failure_share is None:
        return weights
    task, failed = episodes[TASK_ID].squeeze(-1).cpu(), ~episodes["success"].any(-1).cpu()
    shared = torch.zeros_like(weights)
    for number in task.unique():
        for outcome, share in ((True, failure_share), (False, 1 - failure_share)):
            rows = (task == number) & (failed == outcome)
            shared[rows] = share * weights[rows] / weights[rows].sum().clamp_min(1)
        shared[task == number] /= shared[task == number].sum().clamp_min(1e-9)  # one outcome may be missing
    return shared if shared.any() else weights

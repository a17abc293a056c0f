"""Where the rollouts of an :class:`~worldenv_trl.envs.ImaginedEnv` begin: drawn, or given by the caller."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import NonTensorStack, TensorDict, TensorDictBase
from torch import Tensor, nn

from worldenv_trl.envs.branch_points import BranchPoints
from worldenv_trl.envs.contexts import ContextOrder, context_keys
from worldenv_trl.envs.starts import GivenStarts
from worldenv_trl.keys import (
    CONTEXT_ID,
    INSTRUCTION,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    STATE,
    TASK_ID,
    frames_key,
    image_key,
)
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.language import instructions_of
from worldenv_trl.row_share import own_items

__all__ = ["ImaginedStarts"]


class ImaginedStarts(GivenStarts):
    """Of an env [G, N] whose groups begin at contexts, or in the middle of recorded episodes."""

    branch_points: BranchPoints | None
    cameras: tuple[str, ...]
    chunk_length: int
    device: torch.device
    image_size: int
    kinematics: ForwardKinematics
    _context: Tensor
    _contexts: TensorDictBase
    _decisions: Tensor
    _instructions: list[str]
    _kinematic: Tensor
    _order: ContextOrder
    _point: Tensor  # [G * N], of the branch points; -1 for a context
    _poses: Tensor
    _resets: Tensor
    _seed: int
    _slot: Tensor
    _state: Tensor
    _steps: Tensor
    _task: Tensor
    _text: list[str]
    _text_stack: NonTensorStack | None

    def _set_seed(self, seed: int | None) -> None:
        self._seed = int(torch.randint(2**31, ()).item()) if seed is None else int(seed)
        self._order.seed(self._seed)
        self._branching = torch.Generator().manual_seed(self._seed)
        self._resets.zero_()

    def order_state(self) -> dict[str, Any]:
        """What decides where, and with which noise, the next reset of all rows begins; take it between waves."""
        branching = self._branching.get_state()
        order = {"order": self._order.state_dict(), "branching": branching}
        return {"seed": self._seed, **order, "resets": self._resets.clone()}

    def load_order_state(self, state: dict[str, Any]) -> None:
        """Lets the next reset of all rows begin as it would have where :meth:`order_state` gave ``state``."""
        self._seed = state["seed"]
        self._order.load_state_dict(state["order"])
        if "branching" in state:  # not in a state of before there were branches
            self._branching.set_state(state["branching"])
        self._resets.copy_(state["resets"])

    def draw_starts(self) -> TensorDict:
        """Draws what the next reset of all rows would begin with, and counts as that reset; nothing is loaded.

        Returns:
            TensorDict ``[G, N]``: ``place`` int64 in the contexts [K], and behind them in the branch points, and
            ``episode`` int64, by which the noise of a row's rollouts differs. For :meth:`begin_with`.
        """
        groups, rollouts = self.batch_size
        self._resets += 1
        place = self._draw(groups).view(groups, rollouts)
        starts = {"place": place, "episode": self._resets.cpu().view(groups, rollouts).clone()}
        return TensorDict(starts, self.batch_size)

    def past(self, rows: Tensor) -> list[tuple[Tensor, TensorDict]]:
        """What was shown before the rollouts of ``rows`` [n] began, of those that began in the middle of an episode.

        Returns:
            For each step t at which some began: which of ``rows`` they are, int64 [m], and TensorDict [m] of the real
            ``("frames", entry)`` uint8 [m, t + 1, 3, H, W] by camera and ``kinematic_states`` [m, t + 1, 20].
        """
        points = self._point[rows].cpu()
        branched = (points >= 0).nonzero().squeeze(-1)
        if not len(branched) or self.branch_points is None:
            return []
        step, shown = self.branch_points.steps[points[branched]], []
        for each in step.unique().tolist():
            chosen = branched[step == each]
            video = self.branch_points.past(points[chosen])
            keys = [KINEMATIC_STATES, *map(frames_key, self.cameras)]
            shown.append((chosen.to(self.device), video.select(*keys).to(self.device)))
        return shown

    # ------------------------------------------------------------------------------------------------- loading

    def _draw(self, groups: int) -> Tensor:
        """Where the rows of the next ``groups`` groups begin, int64 [groups * N]."""
        drawn = own_items(self._drawn, groups)
        return torch.tensor(drawn, dtype=torch.int64).repeat_interleave(self.batch_size[1])

    def _drawn(self, groups: int) -> list[int]:
        places = self._order.draw(groups)
        if self.branch_points is None or not self.branch_points.share:
            return places
        tasks = self._contexts[TASK_ID].flatten()[places].tolist()
        points = [self.branch_points.draw(task, self._branching) for task in tasks]
        count = len(self._contexts)
        return [place if point is None else count + point for place, point in zip(places, points, strict=True)]

    def _load_places(self, rows: Tensor, place: Tensor) -> None:
        """Put what :meth:`_draw` drew for ``rows`` [n] there."""
        count = len(self._contexts)
        at_context = place < count
        self._point[rows] = torch.where(at_context, -1, place - count).to(self.device)
        index = place[at_context]
        text = [self._instructions[i] for i in index.tolist()]
        self._load(rows[at_context.to(rows.device)], self._contexts[index.to(self._contexts.device)], text)
        if bool(at_context.all()) or self.branch_points is None:
            return
        rows, points = rows[~at_context.to(rows.device)], place[~at_context] - count
        start, text = self.branch_points.starts(points)
        self._load(rows, start, text)
        for step in self.branch_points.steps[points].unique().tolist():
            self._remember(rows, points, step)

    def _remember(self, rows: Tensor, points: Tensor, step: int) -> None:
        """The recorded past of those ``rows`` [n] whose ``points`` [n] are at ``step``."""
        assert self.branch_points is not None
        chosen = self.branch_points.steps[points] == step
        rows, points = rows[chosen.to(rows.device)], points[chosen]
        poses = self.kinematics.pose(self.branch_points.kinematic_states(points, step + 1).to(self.device))
        self._poses[rows, : step + 1] = poses
        slot = self._slot[: step + 1].cpu()
        numbers = (slot >= 0).nonzero().squeeze(-1)
        for camera in self.cameras:
            frames = self.branch_points.frames(camera, points, numbers).to(self.device)
            self._kept(camera)[rows.unsqueeze(-1), slot[numbers].to(self.device)] = frames

    def _load(self, rows: Tensor, start: TensorDictBase, text: list[str]) -> None:
        """Put ``start`` [n] into ``rows`` [n]."""
        start = start.to(self.device)
        for camera in self.cameras:
            self._kept(camera)[rows, 0] = self._image(camera)[rows] = start[image_key(camera)]
        self._state[rows] = start[STATE].unsqueeze(1)
        self._kinematic[rows] = start[KINEMATIC_STATE].unsqueeze(1)
        self._poses[rows, 0] = self.kinematics.pose(start[KINEMATIC_STATE])
        self._task[rows], self._context[rows] = start[TASK_ID], start[CONTEXT_ID]
        for row, words in zip(rows.tolist(), text, strict=True):
            self._text[row] = words
        self._text_stack = None

    def _rewind(self, rows: Tensor) -> None:
        """Back to where the rollouts of ``rows`` began."""
        self._kinematic[rows, 1], self._state[rows, 1] = self._kinematic[rows, 0], self._state[rows, 0]
        for camera in self.cameras:
            self._image(camera)[rows] = self._kept(camera)[rows, 0]
        self._steps[rows] = 0
        self._decisions[rows] = 0
        points = self._point[rows].cpu()
        if self.branch_points is None or not bool((points >= 0).any()):
            return
        branched = points >= 0
        rows, points = rows[branched.to(rows.device)], points[branched]
        step = self.branch_points.steps[points]
        self._steps[rows] = step.to(self.device)
        self._decisions[rows] = (step // self.chunk_length).to(self.device)
        start, _ = self.branch_points.starts(points)
        for camera in self.cameras:
            self._image(camera)[rows] = start[image_key(camera)].to(self.device)

    def _given(self, tensordict: TensorDictBase | None, rows: Tensor) -> tuple[TensorDictBase, list[str]]:
        """The contexts of ``rows`` that the caller put into the reset's tensordict."""
        keys = set() if tensordict is None else set(tensordict.keys(True, True))
        needed = context_keys(self.cameras)
        missing = [key for key in needed if key not in keys]
        if tensordict is None or missing:
            raise ValueError(f"reset(set_state=True) needs {needed} in its tensordict; missing: {missing}")
        start = tensordict.select(*needed).to(self.device).flatten(0, 1)[rows]
        size = (3, self.image_size, self.image_size)
        for camera in self.cameras:
            if tuple(start[image_key(camera)].shape[1:]) != size:
                raise ValueError(
                    f"the contexts' {image_key(camera)} is {tuple(start[image_key(camera)].shape[1:])}, not {size}"
                )
        if INSTRUCTION in tensordict.keys():  # noqa: SIM118 - a TensorDict iterates over rows
            text = instructions_of(tensordict)
            return start, [text[row] for row in rows.tolist()]
        by_task = dict(zip(self._contexts[TASK_ID].flatten().tolist(), self._instructions, strict=True))
        return start, [by_task.get(task, "") for task in start[TASK_ID].flatten().tolist()]

    def _kept(self, camera: str) -> Tensor:
        """The frames that may be asked for: uint8 [G * N, K, 3, H, W]."""
        return cast(nn.Module, self).get_buffer(f"_memory_{camera}")

    def _image(self, camera: str) -> Tensor:
        """What is seen now: uint8 [G * N, 3, H, W]."""
        return cast(nn.Module, self).get_buffer(f"_image_{camera}")

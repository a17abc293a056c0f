"""Where the rollouts of an :class:`~worldenv_trl.envs.ImaginedEnv` begin: drawn, or given by the caller."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import NonTensorStack, TensorDict, TensorDictBase
from torch import Tensor, nn

from worldenv_trl.envs.contexts import ContextOrder, context_keys
from worldenv_trl.envs.starts import GivenStarts
from worldenv_trl.keys import (
    CONTEXT_ID,
    INSTRUCTION,
    KINEMATIC_STATE,
    STATE,
    TASK_ID,
    image_key,
)
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.language import instructions_of
from worldenv_trl.row_share import own_items

__all__ = ["ImaginedStarts"]


class ImaginedStarts(GivenStarts):
    """Of an env [G, N] whose groups begin at contexts."""

    cameras: tuple[str, ...]
    device: torch.device
    image_size: int
    kinematics: ForwardKinematics
    _context: Tensor
    _contexts: TensorDictBase
    _decisions: Tensor
    _instructions: list[str]
    _kinematic: Tensor
    _order: ContextOrder
    _poses: Tensor
    _resets: Tensor
    _seed: int
    _state: Tensor
    _steps: Tensor
    _task: Tensor
    _text: list[str]
    _text_stack: NonTensorStack | None

    def _set_seed(self, seed: int | None) -> None:
        self._seed = int(torch.randint(2**31, ()).item()) if seed is None else int(seed)
        self._order.seed(self._seed)
        self._resets.zero_()

    def order_state(self) -> dict[str, Any]:
        """What decides where, and with which noise, the next reset of all rows begins; take it between waves."""
        return {"seed": self._seed, "order": self._order.state_dict(), "resets": self._resets.clone()}

    def load_order_state(self, state: dict[str, Any]) -> None:
        """Lets the next reset of all rows begin as it would have where :meth:`order_state` gave ``state``."""
        self._seed = state["seed"]
        self._order.load_state_dict(state["order"])
        self._resets.copy_(state["resets"])

    def draw_starts(self) -> TensorDict:
        """Draws what the next reset of all rows would begin with, and counts as that reset; nothing is loaded.

        Returns:
            TensorDict ``[G, N]``: ``place`` int64 in the contexts [K], and ``episode`` int64, by which the noise of a
            row's rollouts differs. For :meth:`begin_with`.
        """
        groups, rollouts = self.batch_size
        self._resets += 1
        place = self._draw(groups).view(groups, rollouts)
        starts = {"place": place, "episode": self._resets.cpu().view(groups, rollouts).clone()}
        return TensorDict(starts, self.batch_size)

    # ------------------------------------------------------------------------------------------------- loading

    def _draw(self, groups: int) -> Tensor:
        """Where the rows of the next ``groups`` groups begin, int64 [groups * N]."""
        drawn = own_items(self._order.draw, groups)
        return torch.tensor(drawn, dtype=torch.int64).repeat_interleave(self.batch_size[1])

    def _load_places(self, rows: Tensor, place: Tensor) -> None:
        """Put what :meth:`_draw` drew for ``rows`` [n] there."""
        text = [self._instructions[i] for i in place.tolist()]
        self._load(rows, self._contexts[place.to(self._contexts.device)], text)

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

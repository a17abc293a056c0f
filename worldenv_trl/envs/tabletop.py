"""Batched tabletop tasks in MuJoCo as a TorchRL environment."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from worldenv_trl.context_ids import UNKNOWN_CONTEXT
from worldenv_trl.envs.init_states import InitStates
from worldenv_trl.envs.tabletop_arguments import (
    check_cameras,
    check_counts,
    check_flags,
    check_numbers,
    check_whole,
    task_numbers,
    tasks_of,
)
from worldenv_trl.envs.tabletop_specs import tabletop_specs
from worldenv_trl.envs.tabletop_starts import Block, TabletopStarts
from worldenv_trl.keys import (
    ACTION,
    ACTION_DIM,
    CONTEXT_ID,
    INSTRUCTION,
    KINEMATIC_DIM,
    KINEMATIC_STATE,
    NUM_STEPS,
    SIM_STATE,
    STATE_DIM,
    SUCCESS,
    TASK_ID,
    image_entry,
)
from worldenv_trl.row_texts import row_texts
from worldenv_trl.scenes import RendererPool, SceneBatch, Task
from worldenv_trl.scenes.simulation import measured_states, step_together

__all__ = ["TabletopEnv"]


class TabletopEnv(TabletopStarts, EnvBase):
    """``num_envs`` copies of one or several tasks, stepped and rendered together. Batch-locked; honours ``_step``.

    A row's episode is a function of (seed, number of the episode, actions), bit for bit, whatever the batch and the
    threads: a batch of 16 draws in one reset what one row draws in 16. A row whose physics blows up is truncated, with
    a warning that says how to see it again; the others do not notice. A row that has ended reports its end until it is
    reset, whether it is stepped or not.

    Args:
        task: a task, its name or file, or several: groups of rows are dealt to the tasks in turn (round robin).
        num_envs: rows.

    Keyword Args:
        image_size: height and width (px), at least 16.
        task_ids: the tasks' numbers in this run, distinct and at least 0; 0, 1, ... in their order by default.
        cameras: of the scenes, each written to its :func:`~worldenv_trl.keys.image_key`: ``agentview`` to
            ``("observation", "image")``, ``wrist`` to ``("observation", "wrist_image")``, any other to
            ``("observation", its name)``; an empty tuple renders nothing.
        init_split: ``train`` or ``test``.
        init_state_mode: ``random`` (shuffled passes), ``cycle`` (in order, reset after reset) or ``fixed``.
        init_state_id: the fixed state, or where the cycle starts.
        init_state_count: how many states of the split take part, at most 50,000; 50 is the standard protocol.
        init_states: float64 [K, S] to use instead of the split's (one task only), with their ``context_ids`` [K].
        group_repeats: that many consecutive rows share one initial state (the rollouts of an RLOO group).
        terminate_on_success: end a row when its goal holds; reward is 1 on that step, else 0. When False, a row runs to
            ``max_steps`` and reward is the success of each step.
        max_steps: env steps after which a row is truncated; the task's own when None.
        proprio: ``commanded`` writes the controller's targets, ``measured`` the hand's pose and opening as they are.
        with_sim_state: write MuJoCo's integration state, padded with zeros to the longest of the tasks.
        seed: of the order of initial states; drawn from torch's generator when None.
        num_threads: of physics, and processes that draw (this one, and helpers that start once they pay); torch's
            number by default, two at most.

    Keys written: the images, ``("observation", "state")``, ``kinematic_state``, ``language_instruction``, ``task_id``,
    ``context_id`` (:func:`~worldenv_trl.context_ids.context_id`), ``num_steps``, ``success``, optionally
    ``sim_state``; then ``reward``, ``done``, ``terminated``, ``truncated``.

    ``reset(td, set_state=True)`` starts every row from ``td``: from its ``sim_state`` (continuing at its ``num_steps``,
    if given) or else from the initial state its ``context_id`` names. Transforms around the env hand ``sim_state`` on
    only if it was built with ``with_sim_state``.

    Raises:
        TypeError: naming the argument that is of another kind.
        ValueError: naming the unknown task, camera, split or mode, the size out of bounds, or the wrong states.
        RuntimeError: if images are asked for and no GL backend works; from ``reset`` and ``step`` of a closed env.

    Examples:
        >>> env = TabletopEnv("starter/open_the_top_drawer", 4, seed=0)
        >>> rollout = env.rollout(3)
        >>> rollout["observation", "image"].shape
        torch.Size([4, 3, 3, 64, 64])
    """

    _supports_set_state = True

    def __init__(
        self,
        task: str | Path | Task | Sequence[str | Path | Task],
        num_envs: int = 1,
        *,
        task_ids: Sequence[int] | None = None,
        image_size: int = 64,
        cameras: Sequence[str] = ("agentview",),
        init_split: str = "train",
        init_state_mode: str = "random",
        init_state_id: int = 0,
        init_state_count: int = 50,
        init_states: np.ndarray | torch.Tensor | None = None,
        context_ids: Sequence[int] | None = None,
        group_repeats: int = 1,
        terminate_on_success: bool = True,
        max_steps: int | None = None,
        proprio: str = "commanded",
        with_sim_state: bool = False,
        seed: int | None = None,
        num_threads: int | None = None,
    ) -> None:
        tasks = tasks_of(task)
        check_numbers(num_envs, group_repeats, num_threads, seed, max_steps, init_state_count, init_state_id)
        check_flags(terminate_on_success=terminate_on_success, with_sim_state=with_sim_state)
        check_counts(tasks, num_envs, group_repeats)
        if proprio not in ("commanded", "measured"):
            raise ValueError(f"proprio must be 'commanded' or 'measured', got {proprio!r}")
        if init_states is not None and len(tasks) > 1:
            raise ValueError("init_states are of one task: build one env for each task")
        numbers = task_numbers(task_ids, tasks)
        check_cameras(cameras, tasks)
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.tasks, self.task_ids = tuple(tasks), numbers
        self.cameras, self.image_size = tuple(cameras), image_size
        self.terminate_on_success, self.proprio, self.with_sim_state = terminate_on_success, proprio, with_sim_state
        starts = [
            InitStates(
                item,
                task_id=number,
                split=init_split,
                mode=init_state_mode,
                count=init_state_count,
                init_state_id=init_state_id,
                states=init_states,
                context_ids=context_ids,
            )
            for item, number in zip(tasks, numbers, strict=True)
        ]
        group = np.arange(num_envs) // group_repeats
        threads = min(min(2, torch.get_num_threads()) if num_threads is None else num_threads, num_envs)
        self._executor = ThreadPoolExecutor(threads) if len(tasks) > 1 and threads > 1 else None
        self._pool = RendererPool(threads) if cameras else None
        self._blocks: list[Block] = []
        for slot, (item, choice) in enumerate(zip(tasks, starts, strict=True)):
            rows = np.flatnonzero(group % len(tasks) == slot)
            # Many rows of a task are shared among the threads; tasks of few rows are dealt to them whole.
            inside = threads if len(tasks) == 1 or len(rows) >= 2 * threads else 1
            scene = SceneBatch(
                item, len(rows), image_size=image_size, cameras=cameras, num_threads=inside, pool=self._pool
            )
            groups = group[rows] // len(tasks)
            self._blocks.append(Block(scene, choice, rows, groups, int(groups.max()) + 1))
        self._make_buffers(max_steps)
        self._make_specs()
        self._set_seed(seed)
        self.is_closed = False

    # ------------------------------------------------------------------------------------------------- set-up

    def _make_buffers(self, max_steps: int | None) -> None:
        n, size = self.num_envs, self.image_size
        self._images = {name: np.zeros((n, 3, size, size), np.uint8) for name in self.cameras}
        self._state = np.zeros((n, STATE_DIM), np.float32)
        self._kinematic = np.zeros((n, KINEMATIC_DIM), np.float32)
        self._sim_size = max(block.scene.batch.nstate for block in self._blocks)
        self._context, self._steps = np.full((n, 1), UNKNOWN_CONTEXT, np.int64), np.zeros((n, 1), np.int64)
        self._success, self._terminated, self._truncated = (np.zeros((n, 1), bool) for _ in range(3))
        self._reward = np.zeros((n, 1), np.float32)
        self._drawing, self._moved = True, np.zeros(n, bool)  # what is not drawn yet has moved
        self._task, self._limit = np.zeros((n, 1), np.int64), np.zeros((n, 1), np.int64)
        words = [""] * n
        for block in self._blocks:
            task = block.scene.task
            self._task[block.rows] = block.starts.task_id
            self._limit[block.rows] = task.max_steps if max_steps is None else max_steps
            for row in block.rows:
                words[row] = task.language
        self._text = row_texts(words, self.device)

    def _make_specs(self) -> None:
        images = {image_entry(name): image.shape[1:] for name, image in self._images.items()}
        width = self._sim_size if self.with_sim_state else None
        specs = tabletop_specs(self.batch_size, images, self.tasks[0].language, width)
        self.observation_spec, self.state_spec, self.action_spec, self.reward_spec, self.done_spec = specs

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            check_whole("seed", seed, 0)
        self._seed = int(torch.randint(2**31, ()).item()) if seed is None else int(seed)
        self._episode = np.full(self.num_envs, -1)
        for block in self._blocks:
            block.starts.seed(self._seed)

    @property
    def num_envs(self) -> int:
        return self.batch_size[0]

    @property
    def scenes(self) -> list[tuple[SceneBatch, np.ndarray]]:
        """The simulation of each task and the rows of the env it runs: privileged state, for experts and checks."""
        return [(block.scene, block.rows) for block in self._blocks]

    @contextmanager
    def undrawn(self) -> Iterator[None]:
        """Steps inside draw nothing and show the images from before: for who does not look at them. The next step or
        :meth:`draw` outside draws every row that has moved since."""
        self._drawing = False
        try:
            yield
        finally:
            self._drawing = True

    def draw(self) -> TensorDict:
        """The images of all rows as they are now, by the name of their entry below ``"observation"``."""
        self._check_open()
        if self._pool is not None and self._moved.any():
            self._start_drawing(np.zeros(self.num_envs, bool))()
        images = {image_entry(name): torch.from_numpy(image.copy()) for name, image in self._images.items()}
        return TensorDict(images, batch_size=self.batch_size, device=self.device)

    def progress(self) -> dict[str, np.ndarray]:
        """``task_id``, ``context_id`` and ``num_steps`` of every row as they are now, int64 [n, 1] each (copies)."""
        return {TASK_ID: self._task.copy(), CONTEXT_ID: self._context.copy(), NUM_STEPS: self._steps.copy()}

    # ------------------------------------------------------------------------------------------------- reset

    def _input_td_has_state(self, tensordict: TensorDictBase | None) -> bool:
        return False  # a state is honoured when set_state=True asks for it, never because it happens to be there

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **_: Any) -> TensorDictBase:
        self._check_open()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = np.ones(self.num_envs, bool) if mask is None else mask.reshape(-1).numpy()
        starts = self._given_starts()
        if set_state:
            self._episode[mask] = self._episode[mask].max(initial=-1) + 1 if mask.all() else self._episode[mask] + 1
        elif mask.all():
            starts = self.draw_starts() if starts is None else starts
            self._episode[:] = starts["episode"].numpy()
        else:
            self._episode[mask] += 1
            starts = None
        self._steps[mask], self._terminated[mask], self._truncated[mask] = 0, False, False
        for block in self._blocks:
            local = np.flatnonzero(mask[block.rows])
            if not len(local):
                continue
            rows = block.rows[local]
            if set_state:
                numbers, states = self._given(tensordict, block, rows)
            elif starts is not None:
                numbers, states = block.starts.at(starts["place"][torch.from_numpy(rows)].tolist())
            else:
                numbers, states = self._drawn(block, local)
            block.scene.reset(local, states)
            self._context[rows, 0] = numbers
        self._read(mask)
        self._reward[mask] = 0
        return self._observe()

    # ------------------------------------------------------------------------------------------------- step

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_open()
        active = tensordict.get("_step", None)
        active = np.ones(self.num_envs, bool) if active is None else active.reshape(-1).numpy()
        action = self._checked_action(tensordict, active)
        broken = np.zeros((self.num_envs, 1), bool)
        shares = [action[block.rows] for block in self._blocks]
        masks = [active[block.rows] for block in self._blocks]
        failures = step_together([block.scene for block in self._blocks], shares, masks, self._executor)
        for block, local in zip(self._blocks, failures, strict=True):
            broken[block.rows[local]] = True
            for row in block.rows[local]:
                warnings.warn(
                    f"{block.scene.task.name}: the physics of row {row} blew up at step {int(self._steps[row, 0])} of "
                    f"episode {int(self._episode[row])} (context {int(self._context[row, 0])}, seed {self._seed}); "
                    "the row is truncated",
                    stacklevel=2,
                )
        self._steps[active] += 1
        self._read(active)
        self._reward[active] = self._success[active]
        running = active[:, None] & ~(self._terminated | self._truncated)  # until now: an end stands until the reset
        self._terminated |= running & self._success & self.terminate_on_success
        self._truncated |= running & ~self._terminated & (broken | (self._steps >= self._limit))
        return self._observe().set("reward", torch.from_numpy(self._reward.copy()))

    def _checked_action(self, tensordict: TensorDictBase, active: np.ndarray) -> np.ndarray:
        action = tensordict.get(ACTION, None)
        expected = (self.num_envs, ACTION_DIM)
        if action is None:
            raise ValueError(f"the tensordict holds no {ACTION!r} {list(expected)}: call the policy first")
        if tuple(action.shape) != expected or not action.is_floating_point():
            raise ValueError(f"{ACTION!r} must be floats {list(expected)}, got {action.dtype} {list(action.shape)}")
        action = action.detach().cpu().to(torch.float64).numpy()
        broken = ~np.isfinite(action).all(-1) & active
        if broken.any():
            raise ValueError(f"{ACTION!r} holds NaN or infinity in rows {np.flatnonzero(broken).tolist()}")
        return action

    def _read(self, active: np.ndarray) -> None:
        """Brings what ``active`` rows show up to date."""
        finish = self._start_drawing(active) if self._drawing and self._pool is not None else None
        if finish is None:
            self._moved |= active
        parts = self._parts(active)
        try:
            if parts:
                self._read_state(parts)  # while the images are drawn
        finally:
            if finish is not None:
                finish()

    def _parts(self, rows: np.ndarray) -> list[tuple[Block, np.ndarray]]:
        """Which of each block's own rows are among ``rows`` bool [n], where there are any."""
        return [(block, local) for block in self._blocks if len(local := np.flatnonzero(rows[block.rows]))]

    def _start_drawing(self, active: np.ndarray) -> Callable[[], None]:
        """Begins to draw ``active`` rows and those that moved undrawn; what it returns waits and keeps the images."""
        parts = self._parts(active | self._moved)
        poses = [block.scene.poses(local) for block, local in parts]
        drawings = [block.scene.drawing for block, _ in parts if block.scene.drawing is not None]
        finish = self._pool.start(drawings, poses) if self._pool is not None and parts else list

        def keep() -> None:
            for (block, local), images in zip(parts, finish(), strict=True):
                for buffer, image in zip(self._images.values(), images.values(), strict=True):
                    buffer[block.rows[local]] = image
            self._moved[:] = False

        return keep

    def _read_state(self, parts: list[tuple[Block, np.ndarray]]) -> None:
        scenes = [block.scene for block, _ in parts]
        if self.proprio == "measured":
            states = np.split(measured_states(scenes), np.cumsum([scene.num_envs for scene in scenes])[:-1])
        else:
            states = [scene.commanded_state() for scene in scenes]
        for (block, local), state in zip(parts, states, strict=True):
            rows = block.rows[local]
            self._state[rows], self._kinematic[rows] = state[local], block.scene.kinematic_state()[local]
            self._success[rows, 0] = block.scene.success()[local]

    def _observe(self) -> TensorDictBase:
        """A copy of what all rows show, and whether they have ended."""
        copies: dict[str, np.ndarray] = {image_entry(name): image.copy() for name, image in self._images.items()}
        copies["state"] = self._state.copy()
        out = {
            "observation": {name: torch.from_numpy(value) for name, value in copies.items()},
            KINEMATIC_STATE: torch.from_numpy(self._kinematic.copy()),
            **{key: torch.from_numpy(value) for key, value in self.progress().items()},
            SUCCESS: torch.from_numpy(self._success.copy()),
            "terminated": torch.from_numpy(self._terminated.copy()),
            "truncated": torch.from_numpy(self._truncated.copy()),
            "done": torch.from_numpy(self._terminated | self._truncated),
        }
        if self.with_sim_state:
            padded = np.zeros((self.num_envs, self._sim_size))
            for block in self._blocks:
                padded[block.rows, : block.scene.batch.nstate] = block.scene.sim_state()
            out[SIM_STATE] = torch.from_numpy(padded)
        out = TensorDict(out, batch_size=self.batch_size, device=self.device)
        out.set(INSTRUCTION, self._text)
        return out

    def _check_open(self) -> None:
        if self.is_closed:
            raise RuntimeError("this TabletopEnv was closed, its renderers and threads are gone: build another one")

    def close(self, *, raise_if_closed: bool = True) -> None:
        if not self.is_closed:
            for block in self._blocks:
                block.scene.close()
            if self._pool is not None:
                self._pool.close()
            if self._executor is not None:
                self._executor.shutdown()
        super().close(raise_if_closed=raise_if_closed)

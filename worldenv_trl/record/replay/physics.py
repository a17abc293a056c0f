"""Recorded actions in the physics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import TransformedEnv
from torchrl.envs.utils import step_mdp

from worldenv_trl.keys import ACTION, CONTEXT_ID, MASK, NUM_STEPS, SIM_STATE, STATE, TASK_ID
from worldenv_trl.record.replay.branch import Branch
from worldenv_trl.record.replay.source import Source, recorded_task

if TYPE_CHECKING:
    from worldenv_trl.envs import Reflect, TabletopEnv
    from worldenv_trl.reflectors import Reflector, StopRule

__all__ = ["replay_physics", "state_parts"]


def replay_physics(
    source: Source,
    branch: Branch | None,
    from_step: int,
    reflector: Reflector | None,
    rule: StopRule | None,
    notes: list[str],
) -> tuple[TensorDict, int]:
    """Steps the physics with the recorded actions, or those of ``branch``.

    Returns:
        Step-level entries [T] and the env step that they begin at.
    """
    env = base = _env_of(source, notes)
    reflect = None
    if reflector is not None and rule is not None:
        from worldenv_trl.envs import Reflect

        reflect = Reflect(reflector, rule)
        env = TransformedEnv(env, reflect)
    try:
        if branch is not None:
            branch.check_policy(env)
        start, first = _start(source, base, from_step, notes)
        td = env.reset(start, set_state=True)
        if reflect is not None and first:
            notes.append(f"the reflector sees the video from step {first} on only")
        return _play(source, env, td, first, branch, reflect), first
    finally:
        env.close(raise_if_closed=False)


def _play(
    source: Source, env: EnvBase, td: TensorDict, first: int, branch: Branch | None, reflect: Reflect | None
) -> TensorDict:
    actions, until = source.actions, source.steps
    turn = until + 1 if branch is None else branch.step
    rule = None if reflect is None else reflect.rule
    if branch is not None and branch.policy is not None:
        until = max(until, int(_innermost(env)._limit.max()))
    if branch is not None and branch.seed is not None:
        torch.manual_seed(branch.seed)
    entries = []
    planned: list[Tensor] = []
    for step in range(first, until):
        if branch is not None:
            branch.direct(reflect, rule, step)
        if branch is not None and step >= turn and branch.policy is not None:
            planned = planned or list(branch.decide(td)[0])
            action = planned.pop(0).clamp(-1, 1)
        elif step < len(actions):
            action = actions[step]
        else:
            break
        action = action.unsqueeze(0) if branch is None else branch.edited(action.unsqueeze(0), step)
        out = env.step(td.set(ACTION, action))
        entries.append(out)
        if step >= turn and bool(out["next", "done"].any()):
            break
        td = step_mdp(out, exclude_action=True)
    played: TensorDict = torch.stack(entries, -1)[0]
    played[MASK] = torch.ones(len(played), dtype=torch.bool)
    return played


def _env_of(source: Source, notes: list[str]) -> TabletopEnv:
    """The env of one row that the rollout was recorded in, as far as the file says."""
    from worldenv_trl.envs import TabletopEnv

    known = source.env
    if not known:
        notes.append("the file does not describe its env: defaults are assumed (record with provenance(env))")
    cameras = tuple(dict.fromkeys((*known.get("cameras", ()), *source.cameras)))
    proprio = known.get("proprio") or _proprio_of(source)
    limit = known.get("max_steps") or source.steps
    limit = max(limit) if isinstance(limit, list) else int(limit)
    return TabletopEnv(
        recorded_task(source, notes),
        1,
        image_size=source.image_size or known.get("image_size", 64),
        cameras=cameras,
        task_ids=(source.task_id or 0,),
        proprio=proprio,
        terminate_on_success=known.get("terminate_on_success", True),
        max_steps=max(limit, source.steps),
        with_sim_state=True,
        num_threads=1,
        seed=0,
    )


def _proprio_of(source: Source) -> str:
    """Commanded proprioception is the controller's target, which the kinematic state repeats."""
    if STATE in source.entries.keys(True) and "kinematic_state" in source.entries.keys():  # noqa: SIM118
        targets = source.entries["kinematic_state"][:, 7:10]
        return "commanded" if torch.equal(source.entries[STATE][:, :3], targets) else "measured"
    return "measured"


def _start(source: Source, env: TabletopEnv, from_step: int, notes: list[str]) -> tuple[TensorDict, int]:
    """What to reset the env to, and its env step: the last recorded state that is not behind ``from_step``."""
    entries = source.entries
    have = set(entries.keys(True, True))
    place = int((source.first <= from_step).nonzero().max())
    start = TensorDict(batch_size=[1])
    if not source.imagined and SIM_STATE in have:
        start[SIM_STATE] = entries[SIM_STATE][place : place + 1]
    else:
        place = 0
        notes.append(
            "no physical state is recorded: it starts from the initial state that the context_id "
            f"{int(entries[CONTEXT_ID][0, 0]) if CONTEXT_ID in have else '(missing)'} names"
        )
    for key in (CONTEXT_ID, TASK_ID, NUM_STEPS):
        if key in have:
            start[key] = entries[key][place : place + 1]
    if SIM_STATE not in start.keys() and CONTEXT_ID not in have:  # noqa: SIM118
        raise ValueError(
            f"{source.path} holds neither {SIM_STATE!r} nor {CONTEXT_ID!r}: the physics has nowhere to start "
            "(record with TabletopEnv(..., with_sim_state=True))"
        )
    return start, int(source.first[place])


def state_parts(source: Source) -> tuple[tuple[str, int], ...]:
    """What a recorded physical state is made of: names and widths, in their order."""
    import mujoco

    model = recorded_task(source, []).build()
    names = {int(value): name for name, value in mujoco.mjtState.__members__.items() if name.startswith("mjSTATE_")}
    single = [(bit, names[1 << bit]) for bit in range(32) if 1 << bit in names]
    whole = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    sizes = [(name, mujoco.mj_stateSize(model, 1 << bit)) for bit, name in single if whole >> bit & 1]
    return tuple((name.removeprefix("mjSTATE_").lower(), size) for name, size in sizes if size)


def _innermost(env: EnvBase) -> EnvBase:
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env

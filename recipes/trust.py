"""Where imagination may teach: how far its verdicts agree with what exploration has found out.

LOOP goes where R is high, and where R does not know what becomes of a dream, that is away from success, while its
returns rise. How the greedy rollouts of the policy that explored ended is known, of each initial state. So it dreams
from there, greedy, too, and what the reflector says of each dream is held against that: no rollout in the physics, and
no more imagination than a few waves.
"""

from __future__ import annotations

from collections.abc import Collection

import torch

from episodes import explored_at, round_of
from imagination import Imagination
from outcomes import imagined_outcomes
from run import Run
from stages import plan
from worldenv_trl import keys
from worldenv_trl.metrics import cohen_kappa
from worldenv_trl.policies import policy_actor


def agreement(run: Run, imagination: Imagination, models: str, tasks: Collection[int]) -> dict[int, float]:
    """Cohen's kappa of imagination's verdicts and exploration's outcomes, of each of the ``tasks`` (ids).

    1 is a verdict that is always right, 0 one that knows nothing; it is 0, too, where all rollouts end alike in one of
    both worlds, and NaN where they do in both.
    """
    explored = explored_at(run, round_of(models), [0.0])
    reached = explored[keys.SUCCESS].flatten(1).any(-1).tolist()
    outcomes = dict(zip(explored[keys.CONTEXT_ID].squeeze(-1).tolist(), reached, strict=True))
    number, task = (imagination.contexts[key].squeeze(-1).cpu() for key in (keys.CONTEXT_ID, keys.TASK_ID))
    known = torch.isin(number, torch.tensor([*outcomes])) & torch.isin(task, torch.tensor([*tasks]))
    rows = known.nonzero().squeeze(-1)
    explorer = next(stage.options["policy"] for stage in plan(run.config) if stage.name == f"explore{models}")
    actor = policy_actor(run.policy(explorer).eval())
    waves = rows.split(run.config.post_train.groups * run.config.post_train.group_size)
    said = torch.cat([imagined_outcomes(run, actor, imagination, imagination.contexts[wave]) for wave in waves])
    real = torch.tensor([outcomes[each] for each in number[rows].tolist()])
    return {each: cohen_kappa(said[task[rows] == each], real[task[rows] == each]).item() for each in tasks}

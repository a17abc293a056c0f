"""The policy learns to do on imagined frames what it does on the real ones, before LOOP shows it no others.

A world model's frames are blurred, and in front of them a policy hesitates and misses where it would not in the world:
what LOOP teaches it then is to see imagined frames, and not much about the task. So explored episodes are imagined, the
same actions from the same first frames, and the policy is distilled into itself: on both sorts of frames its means stay
what they were on the real ones. It costs no rollout and reads no label.

With ``adapt.correct_steps`` it is first taught where its hand has to go, by what exploration found (``correct.py``).

Alone: ``python recipes/adapt.py improve --adapt.steps 500 --begin-from runs/improve --run-dir runs/adapted``.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

import processes
from correct import correct
from data_parallel import DataParallel, WholeOptimizer
from episodes import explored_at, quiet_factors, round_of
from holding import all_held
from imagining import imagined
from physics import exploring_actor
from resumable import Resumable
from run import Run
from stages import run_alone
from updates import rows_at_once
from worldenv_trl import keys
from worldenv_trl.data import Episodes
from worldenv_trl.devices import device_of, to_device
from worldenv_trl.objectives import DistillationLoss
from worldenv_trl.policies import Policy
from worldenv_trl.row_texts import row_texts


def adapt(run: Run, source: str = "sft", target: str = "adapted", models: str = "") -> None:
    """Imagines explored episodes of a round in its world model; writes ``checkpoints/<target>``, where LOOP holds every
    task a copy of ``source``.

    All groups of parameters move that LOOP's rank gives (``Policy.post_training_parameters``).
    """
    config, settings = run.config, run.config.adapt
    run.seed_everything(target)
    policy = run.policy(source).eval()
    if all_held(run, models):  # LOOP is left out
        if processes.is_main():
            print("adapt: left out, all tasks are held")
            policy.save_pretrained(run.folder.checkpoint(target))
        return
    moved = [each for group in policy.post_training_parameters(config.post_train.lora_rank).values() for each in group]
    correct(run, policy, moved, models)
    explored = sampled_as_in_loop(run, round_of(models))
    with run.folder.lasting_scratch() as scratch:
        dreamt = imagined(run, run.world_model(models), explored, target, "explored", scratch)
        decisions = Decisions(explored, dreamt, policy, config.chunk_length)
        decisions.refer(exploring_actor(config, policy, 1.0))
        learner = DataParallel(
            policy, lambda part: DistillationLoss(exploring_actor(config, part, 1.0)), config.parallel
        )
        parameters = learner.trained(moved)
        optimizer = torch.optim.AdamW(parameters, lr=settings.lr, weight_decay=0.0)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, settings.lr, total_steps=settings.steps)
        parts: dict[str, Any] = {"policy": learner, "optimizer": WholeOptimizer(optimizer), "schedule": schedule}
        left = Resumable(run, "steps", settings.steps, **parts)
        for step in left.bar(target):
            rows = processes.own_share(torch.randint(len(decisions), (settings.batch_size,)))
            value = learner(TensorDict.cat([decisions.seen(rows, dreamt=each) for each in (False, True)]))
            optimizer.zero_grad()
            loss = learner.backward_mean(value["loss_distillation"], len(rows))
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()
            schedule.step()
            if step % 50 == 0 or step == settings.steps - 1:
                run.folder.log(target, step=step, loss=loss.item())
        learner.close()
    if processes.is_main():
        policy.save_pretrained(run.folder.checkpoint(target))


def sampled_as_in_loop(run: Run, number: int) -> Episodes:
    """``adapt.episodes_per_task`` explored episodes of each task, or all there are: drawn from the scales that LOOP's
    does not exceed, or from all if there is none."""
    pool = explored_at(run, number, quiet_factors(run.config) or run.config.explore.scale_factors)
    tasks = pool[keys.TASK_ID].squeeze(-1)
    chosen = []
    for task in tasks.unique():
        own = (tasks == task).nonzero().squeeze(-1)
        chosen.append(own[torch.randperm(len(own))[: run.config.adapt.episodes_per_task]])
    return pool[torch.cat(chosen)]


class Decisions:
    """Where episodes decide: once as they were seen and once imagined, and what is done there.

    Args:
        episodes: [R].
        dreamt: the same, imagined.
        policy: that decides.
        chunk_length: steps from one decision to the next.
    """

    def __init__(self, episodes: Episodes, dreamt: Episodes, policy: Policy, chunk_length: int) -> None:
        self._shown, self._device = (episodes, dreamt), device_of(policy)
        self._cameras, self._pixels = policy.cameras, len(policy.cameras) * 3 * policy.image_size**2
        steps = torch.arange(0, episodes["actions"].shape[1], chunk_length)
        self._row, place = (steps < episodes["length"]).nonzero(as_tuple=True)
        self._step = steps[place]
        self._reference: list[Tensor] = []

    def __len__(self) -> int:
        return len(self._row)

    @torch.no_grad()
    def refer(self, actor: Any) -> None:
        """Notes what ``actor`` does where the world is seen."""
        at_once = rows_at_once(self._pixels, self._device.type)
        found = [actor.get_dist(self.seen(rows, dreamt=False)) for rows in torch.arange(len(self)).split(at_once)]
        self._reference = [torch.cat([getattr(each, name) for each in found]) for name in ("loc", "scale")]

    def seen(self, rows: Tensor, *, dreamt: bool) -> TensorDictBase:
        """What a policy sees at the decisions ``rows`` int64 [n]: images uint8 [n, 3, H, W], state [n, 7] and
        instruction, and once :meth:`refer` was called the reference's ``loc`` and ``scale`` [n, C, 7]; on its device.
        """
        row, step = self._row[rows], self._step[rows]
        shown = self._shown[dreamt]
        out = TensorDict({keys.STATE: self._shown[0]["states"][row, step]}, batch_size=[len(rows)])
        for camera in self._cameras:
            out[keys.image_key(camera)] = shown.frames(camera, row, step)
        out[keys.INSTRUCTION] = row_texts([shown.instructions[index] for index in row.tolist()])
        out = to_device(out, self._device)
        for name, values in zip((keys.REFERENCE_LOC, keys.REFERENCE_SCALE), self._reference, strict=False):
            out[name] = values[rows]
        return out


if __name__ == "__main__":
    run_alone("adapt", adapt)

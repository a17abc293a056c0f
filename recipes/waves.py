"""LOOP's waves: groups of rollouts, whole ones in each process.

In imagination every process rolls out its groups; the physics is the main one's, which deals the groups out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

import processes
from collecting import of_worker
from imagination import Imagination, frames_aside
from physics import physics_waves_env
from run import Run
from seeds import another_draw
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import FramesAside
from worldenv_trl.policies import AutoregressiveActor, DeviceBridge, LaplaceActor

_LEARNED_FROM = (
    keys.CHUNK,
    keys.TOKENS,
    keys.TOKEN_IS_PAD,
    keys.LOG_PROBS,
    keys.MASK,
    keys.TASK_ID,
    keys.CONTEXT_ID,
    "returns",
    ("next", keys.STEP_MASK),
    ("next", "terminated"),
)


class Waves:
    """The waves of a post-training run in imagination, or in the physics where there is none, one an iteration.

    Attributes:
        env: in which this process collects; None where another one does.
        collector: as above.
        judges: the parts that give a rollout its return, by name.
    """

    env: EnvBase | None = None
    collector: GroupCollector | None = None

    def __init__(
        self, run: Run, target: str, imagination: Imagination | None, actor: LaplaceActor | AutoregressiveActor
    ) -> None:
        settings, size = run.config.post_train, run.config.post_train.group_size
        self._groups, self._read = settings.groups // processes.size(), [*actor.policy.in_keys, *_LEARNED_FROM]
        self._lived = imagination is None
        self._workers, seed = run.workers is not None, run.seed(target, another_draw(settings.draw, "env"))
        self.judges: dict[str, Any] = {}
        make: Callable[..., EnvBase]
        if imagination is not None:
            self.env = imagination.env(run, [self._groups, size], seed=seed)
            make = imagination.makes(run, size, seed=seed)
            self.judges = {"world_model": imagination.world_model, "reflector": imagination.reflector}
            mine = self._groups
        elif processes.is_main():
            self.env = physics_waves_env(run.config, settings.groups, size, seed=seed)
            make = partial(physics_waves_env, of_worker(run.config), group_size=size, seed=seed)
            mine = settings.groups
        if self.env is not None:
            self.collector = run.group_collector(
                self.env,
                DeviceBridge(actor),
                make,
                steady=False,
                groups_per_batch=mine,
                total_groups=settings.iterations * mine,
                group_size=size,
            )

    @property
    def aside(self) -> FramesAside | None:
        """Where the frames of a wave that is recorded are kept; those of workers come with their waves."""
        return None if self.env is None or self._workers else frames_aside(self.env)

    def record_next(self, yes: bool) -> None:
        """Waves carry what is learned from; those that are recorded carry all, and their frames go to disk. The main
        process records, of imagination the groups that it rolled out."""
        if self.collector is None or self.env is None:
            return
        self.collector.exclude = ["frames"] if yes else ["frames", ("next", "frames"), ("next", "observation")]
        if self.aside is not None:
            self.aside.keep = yes and processes.is_main()

    def __iter__(self) -> Iterator[tuple[TensorDictBase, TensorDictBase]]:
        """``(wave, mine)``: what this process collected, and its groups [G, N, T] of the wave of all; mostly the same.

        All go on with the same random numbers: where one process that had collected all groups would be.
        """
        collected = iter(()) if self.collector is None else iter(self.collector)
        while True:
            if self._lived and processes.size() > 1:
                yield self._dealt(collected)
                continue
            with processes.sharing():
                wave = next(collected, None)
            if wave is None:
                return
            decisions = processes.gathered_values(wave.shape[-1])
            processes.same_random_state(decisions.index(max(decisions)))
            yield wave, wave

    def _dealt(self, collected: Iterator[TensorDictBase]) -> tuple[TensorDictBase, TensorDictBase]:
        lived: list[TensorDictBase] = []
        processes.on_main(lambda: lived.append(next(collected)))
        parts = [part.clone() for wave in lived for part in wave.select(*self._read, strict=False).split(self._groups)]
        mine = processes.dealt(parts)
        return (lived[0] if lived else mine), mine

    def update_policy_weights_(self) -> None:
        """Lets the next wave be collected by the policy as it is now."""
        if self.collector is not None:
            self.collector.update_policy_weights_()

    def shutdown(self) -> None:
        if self.collector is not None:
            self.collector.shutdown()

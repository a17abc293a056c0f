"""One run: its settings, its folder and its parts. Every stage gets one."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase

import processes
from collecting import spread_of, start_workers
from config import WorldEnvConfig
from parts import COMPACT, Parts, check_fits
from run_folder import RunFolder
from seeds import stage_seed
from worldenv_trl.collectors import GroupCollector, SpreadCollector, Workers
from worldenv_trl.devices import choose_device
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.policies import Policy
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.world_models import WorldModel

RULES = "stop_rules.json"
# Frames by which the goal may come after the stop: imagined time is not exact, in front of a camera the stop is final.
LATE = {"real": 0, "imagined": 2}


@dataclass(frozen=True)
class Run:
    config: WorldEnvConfig
    folder: RunFolder
    parts: Parts = COMPACT

    @cached_property
    def device(self) -> torch.device:
        """Where the parts compute; the physics, and all that is read and written, are on the CPU.

        Raises:
            ValueError: for one that does not exist.
        """
        return choose_device(processes.join(self.config.device))

    @cached_property
    def workers(self) -> Workers | None:
        """Who collects rollouts for this process, started when first asked for; None where it does so itself.

        Raises:
            RuntimeError: if a Ray cluster has no room for them.
        """
        spread = spread_of(self.config.collectors)
        return None if spread is None else start_workers(spread, self.device)

    def close(self) -> None:
        """Ends the workers, if there are any."""
        workers = self.__dict__.pop("workers", None)
        if workers is not None:
            workers.shutdown()

    def group_collector(
        self, env: EnvBase, policy: Any, create_env_fn: Callable[[int], EnvBase], *, steady: bool, **options: Any
    ) -> GroupCollector:
        """Collects waves of ``env``: here or, with the envs that ``create_env_fn(groups)`` makes, by the workers.

        Keyword Args:
            steady: whether the policy stays from wave to wave, so that workers may collect several at once.
            options: of :class:`~worldenv_trl.collectors.GroupCollector`.
        """
        spread = spread_of(self.config.collectors)
        if spread is None or self.workers is None:
            return GroupCollector(env, policy, **options)
        spreads = options | {"workers": self.workers, "shares": spread.shares}
        if steady:
            spreads["waves_at_once"] = self.workers.count
        return SpreadCollector(env, policy, create_env_fn=create_env_fn, **spreads)

    @cached_property
    def kinematics(self) -> ForwardKinematics:
        return self.parts.kinematics().to(self.device)

    def seed(self, stage: str, use: str = "") -> int:
        """Of one use of random numbers in a stage; see :func:`seeds.stage_seed`."""
        return stage_seed(self.config.seed, stage, use)

    def seed_everything(self, stage: str, use: str = "") -> None:
        """Each stage has its own stream, so a stage run alone draws the same numbers as in the whole loop."""
        torch.manual_seed(self.seed(stage, use))

    def new(self, name: str) -> Any:
        """The ``policy``, ``world_model`` or ``reflector`` of the run's parts, untrained.

        Raises:
            ValueError: for one that is made for other cameras, images, chunks or proprioception than the run has.
        """
        part = getattr(self.parts, name).make(self.config)
        check_fits(self.config, part)
        return part.to(self.device)

    def policy(self, name: str) -> Policy:
        stage = {"sft": "sft", "adapted": "adapt"}.get(name.split("_")[0], "post_train")
        return self.parts.policy.load(self.folder.require_checkpoint(name, stage)).to(self.device)

    def world_model(self, suffix: str = "") -> WorldModel:
        path = self.folder.require_checkpoint(f"world_model{suffix}", "train_world_model")
        return self.parts.world_model.load(path).eval().to(self.device)

    def reflector(self, suffix: str = "") -> Reflector:
        path = self.folder.require_checkpoint(f"reflector{suffix}", "train_reflector")
        return self.parts.reflector.load(path).eval().requires_grad_(False).to(self.device)

    def rules(self, suffix: str = "") -> dict[str, StopRule]:
        """When the reflector stops ``imagined`` and ``real`` rollouts."""
        return read_rules(self.folder.require_checkpoint(f"reflector{suffix}", "train_reflector"))


def write_rules(folder: Path, rules: dict[str, StopRule]) -> None:
    """Leaves the stop rules beside a reflector's weights."""
    (folder / RULES).write_text(json.dumps({name: asdict(rule) for name, rule in rules.items()}, indent=2) + "\n")


def read_rules(folder: Path) -> dict[str, StopRule]:
    """What :func:`write_rules` left.

    Raises:
        FileNotFoundError: if there are none.
        ValueError: if they cannot be read.
    """
    try:
        return {name: StopRule(**values) for name, values in json.loads((folder / RULES).read_text()).items()}
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{folder / RULES} is missing: run the stage 'train_reflector' again") from error
    except (json.JSONDecodeError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{folder / RULES} holds no stop rules ({error}): run the stage 'train_reflector' again"
        ) from error

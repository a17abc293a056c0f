"""Held-out success of a policy behind a server, alone or beside a run's own policies on the same initial states.

``python recipes/evaluate_external.py improve --run-dir runs/improve --address 127.0.0.1:8765 --against post_train``: a
preset and settings as for ``recipes/world_env.py``, of a run or of a new folder. The scenes show what the server asks
for (cameras, image size, chunk length, proprioception). ``recipes/serve.py`` serves a policy of ours; for others see
``worldenv_trl/policies/README.md``.
"""

from __future__ import annotations

import dataclasses
import sys
from contextlib import closing
from dataclasses import dataclass
from typing import Annotated, Any, NoReturn

import torch
import tyro

from command_line import at_least, refusals
from config import PRESETS, WorldEnvConfig
from evaluate import log_protocol, rolled
from imagination import Imagination
from outcomes import greedy_outcomes
from parts import Part
from run import Run
from stages import open_run, plan
from worldenv_trl.metrics import wilson_interval
from worldenv_trl.policies import ExternalPolicy, check_pairing, policy_actor


@dataclass(frozen=True)
class Settings:
    address: str
    """Of the server: ``host:port`` or ``unix:/path``."""
    config: Annotated[WorldEnvConfig, tyro.conf.arg(name="")]
    name: str = "external"
    """What the policy is called in the run folder; a second one needs another name."""
    against: str | None = None
    """Checkpoint of the run, for instance ``post_train``, to evaluate beside it."""
    imagined: int = 0
    """Training contexts of each task on which it also acts in the run's imagination; 0 leaves that out."""
    timeout: float = 60.0
    """Seconds within which the server has to answer."""


def main(settings: Settings) -> None:
    with refusals():
        at_least(0, imagined=settings.imagined)
        policy = ExternalPolicy.connect(settings.address, timeout=settings.timeout)
        run = open_run(settings.config)
        with closing(run.folder.loggers):
            try:
                compare(run, policy, settings)
            except KeyboardInterrupt:
                raise SystemExit("\ninterrupted: the same command begins again") from None


def compare(run: Run, policy: ExternalPolicy, settings: Settings) -> None:
    """Writes the checkpoint (address and description), recordings and figures under the policy's name."""
    name, folder = settings.name, run.folder
    _check_name(run, name)
    if settings.against is not None:
        run.policy(settings.against)
    shown: dict[str, Any] = {
        "cameras": policy.cameras,
        "image_size": policy.image_size,
        "chunk_length": policy.chunk_length,
    }
    own = dataclasses.replace(
        run,
        config=dataclasses.replace(run.config, **shown),
        parts=dataclasses.replace(run.parts, policy=Part(_made_elsewhere, ExternalPolicy.from_pretrained)),
    )
    imagination = None
    if settings.imagined:
        imagination = Imagination.load(run, "")
        env = imagination.env(run, [1, 1], imagination.contexts[:1], seed=0)
        check_pairing(policy, env)
    policy.save_pretrained(folder.checkpoint(name))
    with folder.stage(name):
        run.seed_everything("evaluate")
        outcomes = (
            {} if settings.against is None else {settings.against: rolled(run, "physics", settings.against, None)}
        )
        outcomes[name] = rolled(own, "physics", name, None)
        log_protocol(folder, name, "physics", outcomes)
        for which, by_task in outcomes.items():
            _say(
                f"{which} ({policy.config.description.name})" if which == name else which,
                torch.cat([*by_task.values()]),
            )
        if imagination is not None:
            actor = policy_actor(own.policy(name))
            found = greedy_outcomes(own, actor, imagination, settings.imagined)
            real, imagined = (torch.cat([*each.values()]) for each in found)
            folder.log(name, real_success=real.float().mean().item(), imagined_success=imagined.float().mean().item())
            _say(f"{name}, training contexts, physics", real)
            _say(f"{name}, training contexts, imagined", imagined)


def _check_name(run: Run, name: str) -> None:
    """Raises ``ValueError`` for a name that is taken, or no name of a folder."""
    path = run.folder.checkpoint(name)
    taken = {stage.name for stage in plan(run.config)} | {"sft", "evaluate"}
    config = path / "config.json"
    other = path.exists() and not (config.is_file() and '"ExternalPolicy"' in config.read_text())
    if not name or path.parent != run.folder.path / "checkpoints" or name in taken or other:
        raise ValueError(f"--name {name!r} is the run's own or no name of a folder: choose another one")


def _say(who: str, success: torch.Tensor) -> None:
    low, high = (float(bound) for bound in wilson_interval(int(success.sum()), len(success)))
    print(f"{who}: {success.float().mean():.3f} [{low:.3f}, {high:.3f}] of {len(success)} episodes")


def _made_elsewhere(config: WorldEnvConfig) -> NoReturn:
    raise RuntimeError("an external policy is made by its server")


def command_line(arguments: list[str]) -> Settings:
    """A preset, its settings, and those of :class:`Settings`."""
    presets = {
        name: (about, Settings(address=tyro.MISSING, config=config)) for name, (about, config) in PRESETS.items()
    }
    return tyro.extras.overridable_config_cli(presets, args=arguments, description=__doc__)


if __name__ == "__main__":
    main(command_line(sys.argv[1:]))

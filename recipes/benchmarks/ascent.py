"""How far uphill LOOP's gradient leads: what a step of its heads is worth to real success.

``python recipes/benchmarks/ascent.py runs/improve``. Waves of a policy's groups are lived in the physics, sampled as
LOOP samples them, half to make directions of, half to hold them against; kept in ``RUN/ascent``. A direction is
the mean of the groups' gradients of log-likelihood times leave-one-out advantage over the heads' parameters, of one
wave (the mean of all that there are is shown) or of all together: plain, or each parameter's mean divided by its root
mean square over the groups, as Adam does.

The slope is what real, sampled success rises by along it, to first order, for a unit of sqrt(2 KL) a step: the product
with the mean gradient of the held-out groups, with 95 % intervals from a bootstrap over these groups, task by task, and
over the waves. ``--imagined`` makes the directions of waves of the run's world model and reflector instead.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict, TensorDictBase, pad
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from command_line import at_least, refusals
from gather_evidence import read_config
from imagination import Imagination
from learning_curves import bootstrap_interval
from parts import instructions
from physics import exploring_actor
from run import Run
from run_folder import RunFolder
from threads import use_threads
from waves import Waves
from worldenv_trl import keys
from worldenv_trl.objectives import rloo_advantage
from worldenv_trl.policies import LaplaceActor, Policy
from worldenv_trl.record import model_hash
from worldenv_trl.report import RunRecord

_STEP = 1e-3  # of the finite difference, in the norm of the parameters
_LOOKED_AT = 512  # decisions, for the KL of a step


@dataclasses.dataclass(frozen=True)
class Settings:
    run: tyro.conf.Positional[Path]
    """Run folder of recipes/world_env.py: its tasks, training initial states and checkpoints."""
    policy: str = "sft"
    """Checkpoint of the run."""
    waves: int = 6
    """Of ``post_train.groups`` groups each: so many for directions, and so many held out."""
    scale_factor: float | None = None
    """Multiple of the policy's scale that is sampled with; the run's post_train.scale_factor if not given."""
    imagined: bool = False
    """Directions from imagination."""
    seed: int = 0
    """Of the samples and initial states."""
    num_threads: int = 1
    device: str = "auto"


def main(settings: Settings) -> list[tuple[str, Tensor]]:
    with refusals():
        at_least(1, waves=settings.waves)
        use_threads(settings.num_threads)
        config = read_config(RunRecord.read(settings.run), settings.num_threads, settings.device)
        factor = config.post_train.scale_factor if settings.scale_factor is None else settings.scale_factor
        sampled = dataclasses.replace(config.post_train, iterations=settings.waves, scale_factor=factor)
        config = dataclasses.replace(config, post_train=sampled)
        run = Run(config, RunFolder(settings.run))
        policy = run.policy(settings.policy).eval()
        actor = exploring_actor(config, policy, factor, sampled.noise)
        if not isinstance(actor, LaplaceActor):
            raise ValueError(f"{type(policy).__name__} acts by tokens: directions are measured of Laplace policies")
    models = model_hash(policy)[:8]
    heads = policy.post_training_parameters(config.post_train.lora_rank)["heads"]
    policy.requires_grad_(False)
    for parameter in heads:
        parameter.requires_grad_(True)
    drawn, names = {}, ("imagined" if settings.imagined else "directions", "held out")
    for name in names:
        world, seed = "imagined" if name == "imagined" else "tabletop", 2 * settings.seed + (name == "held out")
        by = models + "".join(
            model_hash(part())[:8] for part in (run.world_model, run.reflector) if world == "imagined"
        )
        kept = f"{name}_{settings.waves}_{factor:g}_{seed}_{by}".replace(" ", "_")
        drawn[name] = lived(run, policy, actor, world, seed, settings.run / "ascent" / kept)
    shown, held_out = drawn.values()
    for name, waves in drawn.items():
        if not (waves["returns"].std(1) > 0).any():
            refused = f"{name}: rollouts of a group end alike (mean return {waves['returns'].mean():.3f}): no slope"
            raise SystemExit(f"{refused}; take more waves or another scale_factor")
    print(f"{names[0]}: mean return {shown['returns'].mean():.3f}, held out: {held_out['returns'].mean():.3f}")
    found, truth = (gradients(actor, waves, leave_one_out(waves), heads) for waves in (shown, held_out))
    print("\n| groups | step | slope |\n|---|---|---|")
    rows, wave, tasks = [], config.post_train.groups, held_out[keys.TASK_ID][:, 0, 0, 0].numpy()
    for count in sorted({wave, len(found)}):
        for step, made in (("plain", lambda part: part.mean(0)), ("Adam's", _scaled)):
            ways = torch.stack([made(part) for part in found.split(count)])
            slopes = ways @ truth.T / held_out.shape[1] / widths(policy, held_out, ways, heads).unsqueeze(-1)
            low, high = bootstrap_interval(slopes.numpy(), tasks)
            rows.append((f"{count} | {step}", slopes))
            print(f"| {rows[-1][0]} | {slopes.mean():.3f} [{low:.3f}, {high:.3f}] |", flush=True)
    return rows


def lived(run: Run, policy: Policy, actor: LaplaceActor, world: str, seed: int, folder: Path) -> TensorDict:
    """Groups [G, N, T] of the policy: what it saw and did, and ``returns``, alike at all decisions. Made once."""
    if not folder.is_dir():
        config = dataclasses.replace(run.config, seed=seed)
        config = dataclasses.replace(config, post_train=dataclasses.replace(config.post_train, env=world))
        torch.manual_seed(run.seed("ascent", str(seed)))
        imagination = Imagination.load(run, "") if world == "imagined" else None
        waves = Waves(dataclasses.replace(run, config=config), "ascent", imagination, actor)
        waves.record_next(False)
        decisions = -(-config.max_steps // config.chunk_length)
        parts = [_kept(wave, policy, decisions) for wave, _ in waves]
        waves.shutdown()
        torch.cat(parts).memmap(folder)
    waves = TensorDict.load_memmap(folder)
    texts = [instructions(run.config)[int(number)] for number in waves[keys.TASK_ID][:, 0, 0, 0]]
    return torch.stack([group.set(keys.INSTRUCTION, text) for group, text in zip(waves, texts, strict=True)])


def _kept(wave: TensorDictBase, policy: Policy, decisions: int) -> TensorDict:
    """What is read of a wave, padded to ``decisions``. Numbers alone: the text is the task's."""
    names = [*(key for key in policy.in_keys if key != keys.INSTRUCTION), keys.CHUNK, keys.MASK, keys.SCALE]
    named = wave.select(*names, keys.TASK_ID, ("next", keys.STEP_MASK))
    kept = pad(named, [0, 0, 0, 0, 0, decisions - wave.shape[2]])
    kept["returns"] = wave["returns"][:, :, :1].expand(*wave.shape[:2], decisions)
    return kept


def leave_one_out(waves: TensorDictBase) -> Tensor:
    """LOOP's advantages [G, N, T], the same at all decisions."""
    return rloo_advantage(waves["returns"][:, :, 0]).unsqueeze(-1).expand(waves.shape)


def gradients(
    actor: LaplaceActor, waves: TensorDictBase, advantages: Tensor, heads: list[torch.nn.Parameter]
) -> Tensor:
    """Of each group the gradient [G, P] of the sum over its executed steps of log-likelihood times advantage
    [G, N, T]."""
    found = []
    for group, advantage in zip(waves, advantages, strict=True):
        mask = group[keys.MASK]
        decisions = group[mask]
        log_probs = actor.get_dist(decisions.clone()).log_prob(decisions[keys.CHUNK])  # [M, C]
        likelihood = torch.where(decisions["next", keys.STEP_MASK], log_probs, 0.0).sum(-1)
        parts = torch.autograd.grad(likelihood @ advantage[mask].to(likelihood), heads)
        found.append(torch.cat([part.flatten() for part in parts]))
    return torch.stack(found)


def _scaled(each: Tensor) -> Tensor:
    """What Adam makes of the mean of many gradients."""
    root = each.square().mean(0).sqrt()
    return each.mean(0) / (root + 1e-3 * root.square().mean().sqrt())


@torch.no_grad()
def widths(policy: Policy, waves: TensorDictBase, ways: Tensor, heads: list[torch.nn.Parameter]) -> Tensor:
    """How far a unit of each direction [K, P] moves the policy: [K], the root of twice the KL that it comes to a step.

    Of a Laplace density that is the mean's change in units of its scale, root mean square, summed over dimensions.
    """
    decisions = waves[waves[keys.MASK]]
    decisions = decisions[:: max(1, len(decisions) // _LOOKED_AT)]
    steps, scale = decisions["next", keys.STEP_MASK].unsqueeze(-1), decisions[keys.SCALE]
    before, found = policy(decisions.clone())[keys.LOC], []
    for way in ways:
        unit = _STEP / way.norm()
        _move(heads, unit * way)
        moved = (policy(decisions.clone())[keys.LOC] - before) / scale * steps
        _move(heads, -unit * way)
        found.append((moved.square().sum() / steps.sum()).sqrt() / unit)
    return torch.stack(found)


def _move(heads: list[torch.nn.Parameter], by: Tensor) -> None:
    for parameter, part in zip(heads, by.split([each.numel() for each in heads]), strict=True):
        parameter.add_(part.view_as(parameter))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

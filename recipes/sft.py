"""Supervised fine-tuning: L1 on action chunks, then the Laplace scale head alone (World-Env Eq. 8); cross-entropy of a
policy that acts by tokens.

Alone: ``python recipes/sft.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.objectives import BCLoss

import processes
from checks import check_loop
from data_parallel import DataParallel, WholeOptimizer
from episodes import demonstrations
from parts import cameras_of
from resumable import Resumable
from run import Run
from stages import run_alone
from worldenv_trl import keys
from worldenv_trl.data import policy_samples
from worldenv_trl.devices import device_of, to_device
from worldenv_trl.language import instructions_of
from worldenv_trl.objectives import AimedCloning
from worldenv_trl.policies import (
    Aims,
    PlaceShift,
    Policy,
    SceneShift,
    TeacherForcing,
    TokenPolicy,
    laplace_actor,
    likelihood_actor,
    random_shift,
    token_cross_entropy,
)
from worldenv_trl.robot import Camera
from worldenv_trl.row_share import own_rows


def fine_tune(run: Run) -> None:
    """Reads ``rollouts/demonstrations.mcap``, writes ``checkpoints/sft``."""
    config = run.config
    run.seed_everything("sft")
    samples = policy_samples(demonstrations(run), config.chunk_length)
    policy: Policy = run.new("policy")
    check_loop(config, policy)
    policy.fit_statistics(samples[keys.STATE], samples[keys.CHUNK])
    if isinstance(policy, TokenPolicy):
        _clone_tokens(policy, samples, run)
    else:
        _clone_chunks(policy, samples, run)
    if processes.is_main():
        policy.save_pretrained(run.folder.checkpoint("sft"))


def _clone_tokens(policy: TokenPolicy, samples: TensorDictBase, run: Run) -> None:
    settings = run.config.sft
    chunks = samples[keys.CHUNK]
    padding: NestedKey = keys.ACTION_IS_PAD
    tokens = policy.action_tokenizer.encode(chunks.to(device_of(policy)))
    samples[keys.TOKENS] = tokens.to(chunks.device)
    if policy.sequential:  # whole chunks: past the end of an episode, where its last action repeats, too
        padding = keys.TOKEN_IS_PAD
        samples[padding] = policy.token_is_pad(tokens).to(chunks.device)
    learning = [parameter for parameter in policy.parameters() if parameter.requires_grad]

    def cross_entropy(part: TokenPolicy) -> BCLoss:
        actor = TeacherForcing(part)
        return _behaviour_cloning(actor, keys.TOKENS, padding, loss_function=token_cross_entropy)

    shown = Demonstrated(samples, run)
    train(policy, cross_entropy, shown, learning, settings.steps, settings.lr, run, "cross_entropy", padding)


def _clone_chunks(policy: Policy, samples: TensorDictBase, run: Run) -> None:
    settings = run.config.sft
    scale = list(policy.scale_parameters())
    learning = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    others = [parameter for parameter in learning if all(parameter is not each for each in scale)]

    shown = Demonstrated(samples, run)
    train(policy, cloning(policy, run), shown, others, settings.steps, settings.lr, run, "l1")

    # Only the scale moves from here on (World-Env section 4.1).
    policy.requires_grad_(False)
    for parameter in scale:
        parameter.requires_grad_(True)

    def nll(part: Policy) -> BCLoss:
        return _behaviour_cloning(likelihood_actor(part))

    train(policy, nll, shown, scale, settings.scale_steps, settings.scale_lr, run, "nll")


def cloning(policy: Policy, run: Run) -> Callable[[Policy], torch.nn.Module]:
    """What makes the loss that means are taught by: L1, and where the policy aims if it says so."""
    weight = run.config.sft.aim_weight
    aims = weight > 0 and isinstance(policy, Aims)
    if weight > 0 and not aims:
        warnings.warn(
            f"{type(policy).__name__} does not say where it aims: it learns actions alone, without sft.aim_weight",
            stacklevel=2,
        )

    def l1(part: Policy) -> torch.nn.Module:
        loss = _behaviour_cloning(laplace_actor(part), loss_function="l1")
        return AimedCloning(loss, part, _seen(run), weight) if aims else loss

    return l1


def _behaviour_cloning(
    actor: TensorDictModuleBase,
    action: NestedKey = keys.CHUNK,
    padding: NestedKey = keys.ACTION_IS_PAD,
    **options: Any,
) -> BCLoss:
    with warnings.catch_warnings():  # about its own annotations
        warnings.simplefilter("ignore", UserWarning)
        loss = BCLoss(actor, **options)
    loss.set_keys(action=action, pad_mask=padding)
    return loss


def _seen(run: Run) -> dict[str, dict[str, Camera]]:
    """The cameras that the policy looks through, by name and instruction."""
    seen = run.config.sft.cameras or run.config.cameras
    return {name: views for name, views in cameras_of(run.config).items() if name in seen}


class Lessons(Protocol):
    """Samples to imitate, and which of them a batch is made of."""

    @property
    def lowest(self) -> dict[str, float]:
        """The hand's lowest height (m) in the demonstrations of each instruction: where it takes hold of things."""

    def draw(self, count: int) -> torch.Tensor:
        """int64 [count]: numbers of samples for a batch."""

    def __getitem__(self, rows: torch.Tensor) -> TensorDictBase:
        """The samples of these numbers, with what :func:`~worldenv_trl.data.policy_samples` tells of each."""


class Demonstrated:
    """Samples [N] of demonstrations, ``sft.decision_share`` of a batch from where whole chunks begin."""

    def __init__(self, samples: TensorDictBase, run: Run) -> None:
        self._samples, share = samples, run.config.sft.decision_share
        self._weights = decision_weights(samples, run.config.chunk_length, share) if share else None

    @property
    def lowest(self) -> dict[str, float]:
        return lowest_heights(instructions_of(self._samples), self._samples[keys.STATE])

    def draw(self, count: int) -> torch.Tensor:
        if self._weights is None:
            return torch.randint(len(self._samples), (count,))
        return torch.multinomial(self._weights, count, replacement=True)

    def __getitem__(self, rows: torch.Tensor) -> TensorDictBase:
        return self._samples[rows]


def lowest_heights(texts: Sequence[str], states: torch.Tensor) -> dict[str, float]:
    """See :class:`Lessons`; of instructions and states [N, 7]."""
    found: dict[str, float] = {}
    for text, height in zip(texts, states[:, 2].tolist(), strict=True):
        found[text] = min(height, found.get(text, height))
    return found


def decision_weights(samples: TensorDictBase, chunk_length: int, share: float) -> torch.Tensor:
    """How likely each of the samples [N] is drawn, summing to one: ``share`` for those where whole chunks begin."""
    decides = samples[keys.NUM_STEPS].squeeze(-1) % chunk_length == 0
    share = share if decides.any() else 0.0
    return share * decides / decides.sum().clamp_min(1) + (1 - share) / len(samples)


def train(
    policy: Policy,
    make_loss: Callable[[Any], torch.nn.Module],
    lessons: Lessons,
    parameters: list[torch.nn.Parameter],
    steps: int,
    lr: float,
    run: Run,
    name: str,
    padding: NestedKey = keys.ACTION_IS_PAD,
    stage: str = "sft",
) -> None:
    """``steps`` updates of ``parameters`` by batches of ``sft.batch_size`` lessons, moved as SFT's settings say; logged
    as ``stage``, continued under ``name``."""
    settings, learner = run.config.sft, DataParallel(policy, make_loss, run.config.parallel)
    parameters, rows = learner.trained(parameters), settings.batch_size // processes.size()
    images = [keys.image_key(camera) for camera in settings.cameras or run.config.cameras]
    shifts: list[Callable[[TensorDictBase], TensorDictBase]] = []
    if settings.place_shift_m:
        shifts.append(PlaceShift(_seen(run), settings.place_shift_m))
    if settings.scene_shift_m:
        shifts.append(SceneShift(_seen(run), settings.scene_shift_m, height=lessons.lowest))
    optimizer = torch.optim.AdamW(parameters, lr=lr, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1.0, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / max(steps, 1)))
    )
    state: dict[str, Any] = {"policy": learner, "optimizer": WholeOptimizer(optimizer), "schedule": schedule}
    progress = Resumable(run, name, steps, **state).bar(f"{stage} {name}")
    for step in progress:
        with processes.sharing():
            batch = to_device(lessons[own_rows(lessons.draw, rows)], run.device)
            for shift in shifts:
                batch = shift(batch)
            for image in images:
                batch[image] = random_shift(batch[image], settings.shift_px)
        out = learner(batch)
        optimizer.zero_grad()
        value = learner.backward_mean(sum(out.values()), (~batch[padding]).sum())
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        if step % 50 == 0 or step == steps - 1:
            logged = {name: value.item()}
            if "loss_aim" in out:  # of the main process's rows
                logged = {name: out["loss_bc"].item(), "aim": out["loss_aim"].item()}
            run.folder.log(stage, step=step, **logged)
            progress.set_postfix(loss=f"{value.item():.4f}")
    learner.close()


if __name__ == "__main__":
    run_alone("sft", fine_tune)

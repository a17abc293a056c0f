"""What each stage of a run takes: operations, memory of a GPU, seconds. Arithmetic over counted parts alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

from config import WorldEnvConfig
from part_costs import Call, Size
from probes import probed_iterations
from rehearsal import Rehearsal, explored, taught
from stages import Stage, plan
from updates import rows_at_once
from worldenv_trl.reflectors import VLMLessons, VLMReflectorConfig

_PREFIXES = VLMLessons().prefixes_per_episode or 0
_GATHERED = 2  # layers at a time, one computing and the next one on its way
_FRAMES_SEEN = 64  # by a video language model's eyes at once, on a GPU
_PROMPTS_AT_ONCE = VLMReflectorConfig.prompts_per_call


@dataclass(frozen=True)
class Machine:
    """What a plan is made for."""

    name: str
    kind: str
    """``cpu`` or ``cuda``."""
    gpus: int
    flops: float
    """FLOP/s of one GPU's matrix products."""
    memory: float
    """Bytes of one GPU."""
    share: float
    """Of :attr:`flops` that is reached."""

    def seconds(self, flops: float) -> float:
        """Of that many operations, spread over all GPUs."""
        return flops / (self.gpus * self.flops * self.share)


@dataclass(frozen=True)
class Held:
    """A part in a stage."""

    size: Size
    learns: bool = False
    averaged: bool = False
    """Whether LOOP's running mean holds what learns once more."""

    def bytes(self, shards: int) -> float:
        """A GPU's: its shard of weights, gradients and optimiser, and the layers that are gathered to compute."""
        own = self.size.weight_bytes + self.learns * (self.size.gradient_bytes + self.size.optimizer_bytes)
        own += self.averaged * self.size.gradient_bytes  # as large as the weights that they belong to
        return own if shards == 1 else own / shards + min(_GATHERED * self.size.layer_bytes, self.size.weight_bytes)


@dataclass(frozen=True)
class StagePlan:
    """One stage, at most: rollouts that end early take less."""

    name: str
    kind: str
    flops: float
    whole_bytes: float
    """Of a GPU that holds every part whole, beside others that do the same on other rows."""
    sharded_bytes: float
    """Of a GPU that holds a share of every part's weights (FSDP)."""
    activation_bytes: float
    physics: bool = False
    """Whether it waits for the simulator, too, which is not counted."""


def stage_plans(config: WorldEnvConfig, found: Rehearsal, machine: Machine) -> list[StagePlan]:
    """The stages of a run in their order."""
    return [_planned(stage, config, found, machine) for stage in plan(config)]


def _planned(stage: Stage, config: WorldEnvConfig, found: Rehearsal, machine: Machine) -> StagePlan:
    flops = stage_flops(stage.kind, config, found, refit=stage.options.get("previous") is not None)
    held, activations = _memory(stage.kind, config, found, machine)
    return StagePlan(
        stage.name,
        stage.kind,
        flops,
        whole_bytes=sum(part.bytes(1) for part in held) + activations,
        sharded_bytes=sum(part.bytes(machine.gpus) for part in held) + activations,
        activation_bytes=activations,
        physics=stage.kind in ("demonstrate", "explore", "post_train", "evaluate"),
    )


def decisions(config: WorldEnvConfig) -> int:
    """Of a rollout that nothing stops."""
    return config.max_steps // config.chunk_length


def iteration_flops(config: WorldEnvConfig, found: Rehearsal) -> float:
    """Of LOOP, rollouts and updates."""
    settings, calls = config.post_train, found.calls
    rows = settings.groups * settings.group_size * decisions(config)
    lived = calls["decide"].flops
    if settings.env == "imagined":
        lived += calls["imagine"].flops + judged_flops(config, found)
    return rows * (lived + settings.epochs * calls["update"].flops)


def judged_flops(config: WorldEnvConfig, found: Rehearsal) -> float:
    """Of the reflector, for a chunk of one video."""
    return config.chunk_length * found.calls["see"].flops + found.judgements * found.calls["judge"].flops


def stage_flops(kind: str, config: WorldEnvConfig, found: Rehearsal, *, refit: bool = False) -> float:
    """Of all rows of a stage."""
    calls, length, tasks = found.calls, decisions(config), len(config.tasks)
    decide, episodes = calls["decide"].flops, explored(config)
    judged = config.post_train.env == "imagined"
    if kind == "sft":
        scale = 0.0 if "score" in calls else decide  # tokens have no scale head
        steps = config.sft.steps * calls["sft"].flops + config.sft.scale_steps * scale
        return config.sft.batch_size * steps
    if kind == "explore":
        return episodes * length * decide
    if kind == "train_world_model":
        model = config.world_model
        learned = (model.refit_steps if refit else model.steps) * model.batch_size * calls.get("dream", _NOTHING).flops
        return learned + model.holdout * episodes * length * calls["imagine"].flops
    if kind == "train_reflector":
        kept, share = config.reflector.holdout * episodes, config.reflector.imagined_share
        imagined = min(1.0, share / max(1e-6, 1 - share)) * (episodes - kept)
        imagined *= found.judge_reads_video
        painted = (imagined + kept) * length * found.judge_reads_video
        flops = painted * calls["imagine"].flops + 2 * kept * length * judged_flops(config, found)
        if "learn" in calls:
            return flops + calls["learn"].flops
        return flops + (taught(config) + imagined) * (
            config.max_steps * calls["see"].flops + _PREFIXES * calls["judge"].flops
        )
    if kind == "adapt":
        told = config.adapt
        shown = told.episodes_per_task * tasks * length * (calls["imagine"].flops + decide)
        taught_again = told.correct_steps * config.sft.batch_size * calls["update"].flops
        return shown + taught_again + 2 * told.steps * told.batch_size * calls["update"].flops
    if kind == "post_train":
        settings = config.post_train
        looked = settings.probe_contexts * tasks * length
        probe = 2 * decide + calls["imagine"].flops + judged_flops(config, found) if judged else decide
        return settings.iterations * iteration_flops(config, found) + len(probed_iterations(settings)) * looked * probe
    if kind == "evaluate":
        rows = 2 * config.evaluate.episodes_per_task * tasks * length
        return rows * (2 * decide + judged_flops(config, found) if judged else decide)
    return 0.0


_NOTHING = Call(0.0, 0.0)


def _memory(kind: str, config: WorldEnvConfig, found: Rehearsal, machine: Machine) -> tuple[list[Held], float]:
    """The parts that a GPU holds in a stage, and the most that its share of the rows takes beside them."""
    sizes, calls = found.sizes, found.calls

    def rows(whole: int) -> int:
        return -(-whole // machine.gpus)

    def kept(videos: int) -> float:
        return videos * found.kept_bytes * (1 if "learn" in calls else config.max_steps + 1)

    def judging(videos: int) -> float:
        passes = videos if "learn" in calls else min(_PROMPTS_AT_ONCE, videos * found.judgements)
        seen = min(_FRAMES_SEEN, videos * config.chunk_length) * calls["see"].activation_bytes
        return max(seen, passes * calls["judge"].activation_bytes)

    def judged(videos: int) -> float:
        return kept(videos) + judging(videos)

    def imagined(videos: int) -> float:
        painting = min(videos, found.rows_imagined) * calls["imagine"].activation_bytes
        return kept(videos) + max(painting, judging(videos))

    policy, dreamed = Held(sizes["policy"]), config.post_train.env == "imagined"
    dreaming = [Held(sizes["world_model"]), Held(sizes["reflector"])] if dreamed else []
    if kind == "sft":
        return [Held(sizes["sft"], learns=True)], rows(config.sft.batch_size) * calls["sft"].activation_bytes
    if kind == "explore":
        return [policy], rows(config.explore.num_envs) * calls["decide"].activation_bytes
    if kind == "train_world_model":
        batch = rows(config.world_model.batch_size) * calls.get("dream", _NOTHING).activation_bytes
        return [Held(sizes["world_model"], learns=True)], batch
    if kind == "train_reflector":
        learning = calls["learn"].activation_bytes if "learn" in calls else 0.0
        held = [Held(sizes["world_model"]), Held(sizes["reflector"], learns=True)]
        return held, max(learning, imagined(min(found.rows_imagined, rows(explored(config)))))
    if kind == "adapt":
        corrected = rows(config.sft.batch_size) if config.adapt.correct_steps else 0
        batch = max(2 * rows(config.adapt.batch_size), corrected) * calls["update"].activation_bytes
        painting = found.rows_imagined * calls["imagine"].activation_bytes
        return [Held(sizes["policy"], learns=True), Held(sizes["world_model"])], max(batch, painting)
    if kind == "post_train":
        settings = config.post_train
        videos = rows(settings.groups * settings.group_size)
        pixels = len(config.sft.cameras or config.cameras) * 3 * config.image_size**2
        part = min(rows(settings.minibatch_size), rows_at_once(pixels, machine.kind))
        lived = max(videos * calls["decide"].activation_bytes, imagined(videos) if dreamed else 0.0)
        before = [Held(sizes["policy"])] if settings.hold else []
        held = [Held(sizes["policy"], learns=True, averaged=True), *before, *dreaming]
        return held, max(lived, part * calls["update"].activation_bytes)
    if kind == "evaluate":
        batch = rows(config.evaluate.num_envs)
        return [policy, *dreaming[1:]], max(batch * calls["decide"].activation_bytes, judged(batch) if dreamed else 0.0)
    return [], 0.0


def moved_bytes(config: WorldEnvConfig, found: Rehearsal, machine: Machine) -> dict[str, float]:
    """That one GPU sends in an iteration of LOOP, by how weights are held: ``whole`` exchanges gradients alone,
    ``sharded`` (FSDP) gathers what every call reads, twice in an update, and scatters gradients."""
    settings, calls, gradients = config.post_train, found.calls, found.sizes["policy"].gradient_bytes
    share, length = (machine.gpus - 1) / machine.gpus, decisions(config)
    videos = -(-settings.groups * settings.group_size // machine.gpus)
    updates = settings.epochs * math.ceil(settings.groups * settings.group_size * length / settings.minibatch_size)
    lived = length * calls["decide"].read_bytes
    if settings.env == "imagined":
        painted = math.ceil(videos / found.rows_imagined) * calls["imagine"].read_bytes
        seen = math.ceil(videos * config.chunk_length / _FRAMES_SEEN) * calls["see"].read_bytes
        judged = math.ceil(videos * found.judgements / _PROMPTS_AT_ONCE) * calls["judge"].read_bytes
        lived += length * (painted + seen + judged)
    updated = updates * (2 * calls.get("score", calls["decide"]).read_bytes + gradients)
    return {"whole": updates * 2 * share * gradients, "sharded": share * (lived + updated)}


def wave_bytes(config: WorldEnvConfig) -> float:
    """Images that a wave of LOOP keeps until its updates are over."""
    images = len(config.sft.cameras or config.cameras) * 3 * config.image_size**2
    return config.post_train.groups * config.post_train.group_size * decisions(config) * images

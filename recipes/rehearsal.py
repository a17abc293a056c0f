"""One decision, one imagined chunk and one judgement, from end to end: whether the parts fit, and what they cost.

Parts with an outline are on the meta device, where shapes are all there is; others compute on the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from checks import check_loop
from command_line import expected, in_options
from config import WorldEnvConfig
from explore import episodes_of_round
from part_costs import Call, Size, counted, size
from parts import Parts, instructions, misfits
from worldenv_trl import keys
from worldenv_trl.data import Episodes
from worldenv_trl.devices import device_of
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.policies import Policy, TeacherForcing, TokenPolicy, token_cross_entropy
from worldenv_trl.reflectors import Reflector, VLMReflector
from worldenv_trl.row_texts import row_texts
from worldenv_trl.world_models import DiffusionWorldModel, WorldModel, paint, request
from worldenv_trl.world_models.diffusion_training import denoising_loss

ROWS = 2  # everything counted grows with them alike
_FIRST_CHUNK = 16  # frames before the chunk that is imagined


@dataclass
class Rehearsal:
    """What was found."""

    problems: list[str] = field(default_factory=list)
    """What does not fit, a line each."""
    shapes: list[str] = field(default_factory=list)
    """What passed from part to part."""
    sizes: dict[str, Size] = field(default_factory=dict)
    """By part; ``sft`` is the policy as supervised fine-tuning updates it."""
    calls: dict[str, Call] = field(default_factory=dict)
    """``decide``, ``sft``, ``update``: a decision of the policy, and ``score``, one pass over it, where it acts by
    tokens; ``imagine``, ``dream``: a chunk of the world model, painted and learned from; ``see``, ``judge``: a frame
    and a prefix; ``learn``: all of the reflector's lessons."""
    kept_bytes: float = 0.0
    """That the reflector keeps of every frame of a video, or where ``learn`` is known of a video."""
    judgements: int = 1
    """Of a chunk."""
    judge_reads_video: bool = True
    """In imagination; where not, no episodes are imagined for the reflector."""
    rows_imagined: int = 1
    """At once."""


def rehearse(config: WorldEnvConfig, parts: Parts, published: dict[str, Callable] | None = None) -> Rehearsal:
    """Builds the parts and lets one decision pass through them.

    Args:
        config: checked settings.
        parts: those of the run.
        published: by part, what builds one of published sizes instead.
    """
    found, made = Rehearsal(), {}
    for name in ("policy", "world_model", "reflector"):
        part = getattr(parts, name)
        build = (published or {}).get(name) or part.outline or part.make
        with _noted(found, name):
            made[name] = build(config)
    _agree(found, config, made)
    if "policy" in made:
        with _noted(found, "policy"):
            check_loop(config, made["policy"])
    if not found.problems:
        for step in (_act, _imagine, _judge):
            with _noted(found, step.__name__.removeprefix("_")):
                step(found, config, made)
            if found.problems:
                break
    return found


class _noted:
    """Turns an expected error into a line of ``problems``."""

    def __init__(self, found: Rehearsal, name: str) -> None:
        self.found, self.name = found, name.replace("_", " ")

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, where: object) -> bool:
        if isinstance(error, Exception) and expected(error):
            self.found.problems.append(f"{self.name}: {in_options(error)}")
            return True
        return False


def _agree(found: Rehearsal, config: WorldEnvConfig, made: dict[str, Any]) -> None:
    """Whether what the parts were made for is what the run has."""
    texts = instructions(config)
    for name, part in made.items():
        title = name.replace("_", " ")
        found.problems += [f"{title}: {line}" for line in misfits(config, part)]
        unseen = [text for text in texts if part.instructions and text not in part.instructions]
        if unseen:
            found.problems.append(f"{title}: it was not made for the instruction {unseen[0]!r}")


def _act(found: Rehearsal, config: WorldEnvConfig, made: dict[str, Any]) -> None:
    policy: Policy = made["policy"]
    device = device_of(policy)
    texts = _texts(config)
    seen = TensorDict({keys.STATE: torch.zeros(ROWS, keys.STATE_DIM, device=device)}, batch_size=[ROWS])
    for camera in policy.cameras:
        seen[keys.image_key(camera)] = _pixels(config, ROWS, device=device)
    seen.set(keys.INSTRUCTION, row_texts(texts))

    def score() -> Tensor:
        if isinstance(policy, TokenPolicy):
            tokens = torch.zeros(ROWS, *policy.token_shape, dtype=torch.int64, device=device)
            logits = TeacherForcing(policy)(seen.clone(False).set(keys.TOKENS, tokens))[keys.TOKENS]
            return token_cross_entropy(logits, tokens).mean()
        out = policy(seen.clone(False))
        return (out[keys.LOC].abs() / out[keys.LOG_SCALE].exp() + out[keys.LOG_SCALE]).mean()

    def learn() -> None:
        score().backward()

    found.sizes["sft"] = size(policy)
    found.calls["sft"] = counted(policy, ROWS, learn, training=True)
    groups = policy.post_training_parameters(config.post_train.lora_rank)
    found.sizes["policy"] = size(policy, [each for group in groups.values() for each in group])
    same = found.sizes["policy"] == found.sizes["sft"]
    found.calls["update"] = found.calls["sft"] if same else counted(policy, ROWS, learn, training=True)
    found.calls["decide"] = counted(policy, ROWS, lambda: made.update(acted=policy(seen.clone(False))))
    if isinstance(policy, TokenPolicy):
        found.calls["score"] = counted(policy, ROWS, score)
    chunk = made["acted"][keys.LOC]
    wanted = (ROWS, config.chunk_length, keys.ACTION_DIM)
    if tuple(chunk.shape) != wanted:
        raise ValueError(f"the policy must write chunks {wanted}, got {tuple(chunk.shape)}")
    images = ", ".join(policy.cameras)
    found.shapes.append(f"policy: {images} {_shape(seen[keys.image_key(policy.cameras[0])])} -> chunk {_shape(chunk)}")


def _imagine(found: Rehearsal, config: WorldEnvConfig, made: dict[str, Any]) -> None:
    model: WorldModel = made["world_model"].eval()
    device, chunk = device_of(model), made["acted"][keys.LOC]
    start = torch.zeros(ROWS, keys.KINEMATIC_DIM)
    start[:, 10:19] = torch.eye(3).flatten()
    kinematics = ForwardKinematics()  # where the hand is has no bearing on shapes
    poses = kinematics.pose(kinematics.rollout(start, torch.zeros(chunk.shape))).to(device)
    texts, now = _texts(config), torch.full((ROWS,), _FIRST_CHUNK, device=device)

    def recall(numbers: Tensor) -> TensorDict:
        shape = tuple(numbers.shape)
        known = TensorDict({"poses": poses[:, :1].expand(*shape, keys.POSE_DIM)}, batch_size=shape)
        for camera in model.cameras:
            known[keys.frames_key(camera)] = _pixels(config, *shape, device=device)
        return known

    seeds = torch.arange(ROWS, device=device).unsqueeze(-1)
    actions = torch.zeros(chunk.shape, device=device)
    asked = request(model, recall, now, poses, actions, texts, seeds)
    found.sizes["world_model"] = size(model)
    found.rows_imagined = config.post_train.groups * config.post_train.group_size
    if isinstance(model, DiffusionWorldModel):
        found.rows_imagined = model.config.rows_at_once(device)
    found.calls["imagine"] = counted(model, ROWS, lambda: made.update(painted=paint(model, asked)))
    frames = made["painted"][model.cameras[0]]
    found.shapes += [
        f"forward kinematics: chunk {_shape(chunk)} -> poses {_shape(poses)}",
        f"world model: {asked.batch_size[0]} requests of {', '.join(model.cameras)} -> frames {_shape(frames)}",
    ]
    if any(parameter.requires_grad for parameter in model.parameters()):
        loss = _denoising(model, config, asked) if isinstance(model, DiffusionWorldModel) else _windows(model, config)
        found.calls["dream"] = counted(model.train(), ROWS, lambda: loss().backward(), training=True)
        model.eval()


def _denoising(model: DiffusionWorldModel, config: WorldEnvConfig, asked: TensorDict) -> Callable[[], Tensor]:
    """The diffusion loss of latents: a window would be asked for its frames' numbers, which the meta device lacks."""
    device = device_of(model)

    def loss() -> Tensor:
        shape = (ROWS, config.chunk_length, 3, config.image_size, config.image_size)
        clean = torch.cat([model.encode(torch.zeros(shape, device=device)) for _ in model.cameras], -2)
        valid = torch.ones(clean.shape[:2], dtype=torch.bool, device=device)
        return denoising_loss(model, clean, model.conditions(asked, _texts(config)), valid)["loss_world_model"]

    return loss


def _windows(model: WorldModel, config: WorldEnvConfig) -> Callable[[], Tensor]:
    steps = 2 * config.chunk_length
    entries: dict[Any, Tensor] = {keys.frames_key(camera): _pixels(config, ROWS, steps + 1) for camera in model.cameras}
    entries |= {
        "poses": torch.cat([torch.zeros(3), torch.eye(3).flatten(), torch.zeros(1)]).expand(ROWS, steps + 1, -1),
        "number": torch.arange(steps + 1).expand(ROWS, -1),
        "start": torch.zeros(ROWS, 1, dtype=torch.int64),
        "actions": torch.zeros(ROWS, steps, keys.ACTION_DIM),
        "step_mask": torch.ones(ROWS, steps, dtype=torch.bool),
    }
    windows = TensorDict(entries, batch_size=[ROWS])
    windows.set(keys.INSTRUCTION, row_texts(_texts(config)))
    return lambda: model.training_loss(windows)["loss_world_model"]


def _judge(found: Rehearsal, config: WorldEnvConfig, made: dict[str, Any]) -> None:
    reflector: Reflector = made["reflector"].eval()
    device, painted, texts = device_of(reflector), made["painted"], _texts(config)
    if any(camera not in made["world_model"].cameras for camera in reflector.cameras):
        raise ValueError(
            f"it looks through {', '.join(reflector.cameras)}, the world model paints "
            f"{', '.join(made['world_model'].cameras)} alone: name these cameras in its settings"
        )
    frames = {camera: painted[camera].to(device) for camera in reflector.cameras}
    count = ROWS * config.chunk_length
    if isinstance(reflector, VLMReflector):
        found.sizes["reflector"] = size(reflector, reflector.head.parameters())
        video, vlm = frames[reflector.config.camera], reflector.vlm
        found.calls["see"] = counted(vlm, count, lambda: made.update(seen=vlm.encode(video.flatten(0, 1))))
        tokens = made["seen"]
        found.kept_bytes = tokens[0].numel() * tokens.element_size()
        kept = tokens.new_zeros(ROWS, reflector.config.num_frames, *tokens.shape[1:])
        rows, lengths = torch.arange(ROWS), torch.full((ROWS,), reflector.config.num_frames)
        judge = counted(
            reflector, ROWS, lambda: made.update(scores=reflector.prefix_scores(kept, rows, lengths, texts))
        )
        found.calls["judge"] = judge
        found.judgements = math.ceil(config.chunk_length / reflector.config.score_every)
        found.shapes.append(f"reflector: {_shape(video)} -> tokens {_shape(tokens)} -> scores {_shape(made['scores'])}")
        return
    found.sizes["reflector"] = size(reflector)
    imagined = reflector.for_world("imagined")
    found.judge_reads_video = imagined.reads_video
    frames = {camera: frames[camera] for camera in imagined.cameras}
    if imagined.reads_path:
        frames[keys.KINEMATIC_STATES] = torch.zeros(ROWS, config.chunk_length, keys.KINEMATIC_DIM, device=device)
    state = imagined.begin({name: each[:, 0] for name, each in frames.items()}, texts)
    found.kept_bytes = sum(each[0].numel() * each.element_size() for each in state.values() if isinstance(each, Tensor))
    judge = counted(imagined, ROWS, lambda: made.update(scores=imagined.extend(state, frames)[1]))
    found.calls["see"], found.calls["judge"] = Call(0.0, 0.0), judge
    found.calls["learn"] = _lessons(reflector, config)
    found.shapes.append(f"reflector: {_shape(next(iter(frames.values())))} -> scores {_shape(made['scores'])}")


def explored(config: WorldEnvConfig) -> int:
    """Episodes of a round of exploration."""
    return episodes_of_round(config.explore, len(config.tasks))


def taught(config: WorldEnvConfig) -> float:
    """Real episodes that a round's reflector learns from: demonstrations and what of exploration is not kept out."""
    demonstrated = config.demonstrate.episodes_per_task * len(config.tasks)
    return demonstrated + (1 - config.reflector.holdout) * explored(config)


def _lessons(reflector: Reflector, config: WorldEnvConfig) -> Call:
    """A step of each lesson on episodes of noise, times the steps that it has on those of the run."""
    texts = instructions(config)
    count, length = 4 * len(texts), config.max_steps + 1
    shown = TensorDict(
        {keys.frames_key(camera): _pixels(config, count * length) for camera in reflector.cameras},
        batch_size=[count * length],
    )
    task = torch.arange(count).remainder(len(texts)).unsqueeze(-1)
    success = (torch.arange(length) > length // 2) & (torch.arange(count).unsqueeze(-1) % 4 < 2)
    entries = {"actions": torch.zeros(count, length - 1, keys.ACTION_DIM), "success": success, keys.TASK_ID: task}
    entries["length"] = torch.full((count, 1), length - 1)
    entries["kinematic_states"] = torch.zeros(count, length, keys.KINEMATIC_DIM)
    episodes = Episodes(
        TensorDict(entries, batch_size=[count]), [texts[row % len(texts)] for row in range(count)], shown
    )
    flops = activations = 0.0
    for lesson in reflector.train_on(episodes):
        batch = lesson.sample()

        def learn(batch: TensorDict = batch) -> None:
            reflector.training_loss(batch)["loss_reflector"].backward()

        step = counted(reflector, 1, learn, training=True)
        steps = lesson.steps * (taught(config) / count if lesson.by_epochs else 1)
        flops, activations = flops + steps * step.flops, max(activations, step.activation_bytes)
    return Call(flops, activations)


def _texts(config: WorldEnvConfig) -> list[str]:
    texts = instructions(config)
    return [texts[row % len(texts)] for row in range(ROWS)]


def _pixels(config: WorldEnvConfig, *rows: int, device: torch.device | str = "cpu") -> Tensor:
    return torch.zeros(*rows, 3, config.image_size, config.image_size, dtype=torch.uint8, device=device)


def _shape(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"

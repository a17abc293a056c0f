"""The instant reflector: an encoder, then frozen, and a reward head on real and imagined prefixes.

Imagined prefixes are replays of recorded actions in the world model, labelled by what the physics did under them.
Alone: ``python recipes/train_reflector.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import dataclasses

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from tqdm import trange

from config import WorldEnvConfig
from parts import load_world_model, read_episodes, seed_everything, split_by_context
from run_folder import RunFolder
from worldenv_trl import keys
from worldenv_trl.data import concatenate_episodes
from worldenv_trl.data.imagine import imagine_episodes
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.metrics import classification
from worldenv_trl.objectives import ReflectorLoss
from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig, blurred
from worldenv_trl.scenes import load_task

# Frames by which the goal may come after the stop: imagined time is not exact, in front of a camera the stop is final.
LATE = {"real": 0, "imagined": 2}


def run(
    config: WorldEnvConfig, folder: RunFolder, target: str = "reflector", models: str = "", rounds: int = 1
) -> None:
    """Reads the rollouts of the first ``rounds`` rounds; writes ``checkpoints/<target>`` and its held-out figures."""
    settings = config.reflector
    seed_everything(config, offset=40 + rounds)
    demonstrations, explored = read_episodes(folder, rounds)
    training, held_out = split_by_context(explored, settings.holdout, config.seed)
    world_model, kinematics = load_world_model(folder, models), ForwardKinematics()
    share = min(1.0, settings.imagined_share / max(1e-6, 1 - settings.imagined_share))
    chosen = torch.randperm(len(training))[: round(share * len(training))]
    episodes = concatenate_episodes([demonstrations, training])
    if len(chosen):
        label = f"{target} imagines"
        imagined = imagine_episodes(world_model, training[chosen], kinematics, seed=config.seed, progress=label)
        episodes = concatenate_episodes([episodes, imagined])
    imagined_held_out = imagine_episodes(world_model, held_out, kinematics, seed=config.seed + 1)

    tasks = max(load_task(task).task_id for task in config.tasks) + 1
    reflector = CompactReflector(CompactReflectorConfig(num_tasks=tasks, image_size=config.image_size))
    _train_encoder(reflector, episodes, settings, folder, target)
    reflector.encoder.requires_grad_(False)
    _train_head(reflector, episodes, settings, folder, target)
    reflector.eval()

    scores = {"real": all_scores(reflector, held_out), "imagined": all_scores(reflector, imagined_held_out)}
    rules = dict.fromkeys(scores, (settings.threshold, settings.consecutive))
    if settings.choose_threshold:  # on training contexts that no part of the reflector has seen
        rules = {name: choose_rule(values, held_out, LATE[name]) for name, values in scores.items()}
    reflector.config = dataclasses.replace(
        reflector.config,
        threshold=rules["imagined"][0],
        consecutive=rules["imagined"][1],
        real_threshold=rules["real"][0],
        real_consecutive=rules["real"][1],
    )
    reflector.save_pretrained(folder.checkpoint(target))
    for name, values in scores.items():
        for task in ("all", *config.tasks):
            rows = torch.ones(len(held_out), dtype=torch.bool)
            if task != "all":
                rows = held_out[keys.TASK_ID].squeeze(-1) == load_task(task).task_id
            if rows.any():
                _log_figures(folder, target, rules[name], name, task, values[rows], held_out[rows])


def _log_figures(folder: RunFolder, target: str, rule, rollouts: str, task: str, scores, episodes) -> None:
    folder.log(
        target,
        rollouts=rollouts,
        task=task,
        episodes=len(episodes),
        threshold=rule[0],
        consecutive=rule[1],
        **frame_figures(scores, episodes, rule[0]),
        **episode_figures(scores, episodes, rule, LATE[rollouts]),
    )


class _FrameSampler:
    """Draws frames: every task equally often, and of each task successes as often as failures."""

    def __init__(self, episodes: TensorDict) -> None:
        alive, success = _alive(episodes), episodes["success"]
        task = episodes[keys.TASK_ID]  # [R, 1]
        wanted = [(task == number) & alive & (success == label) for number in task.unique() for label in (True, False)]
        self.pools = [pool.nonzero() for pool in wanted if pool.any()]

    def __call__(self, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Episode and frame of ``count`` frames, or a few less."""
        share = max(1, count // len(self.pools))
        return torch.cat([pool[torch.randint(len(pool), (share,))] for pool in self.pools]).unbind(-1)


def _train_encoder(reflector: CompactReflector, episodes: TensorDict, settings, folder: RunFolder, target: str) -> None:
    parameters = reflector.encoder_parameters()
    optimizer = torch.optim.AdamW(parameters, lr=settings.lr, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, settings.lr, total_steps=settings.encoder_steps)
    draw = _FrameSampler(episodes)
    for step in trange(settings.encoder_steps, desc=f"{target} encoder", unit="step"):
        row, frame = draw(2 * settings.batch_size)
        both = torch.cat([episodes["frames"][row, frame], episodes["frames"][row, 0]], 1)
        both = _shifted_together(both)
        now, first = (blurred(images, float(torch.rand(()))) for images in both.split(3, 1))
        noise = 6 * torch.randn_like(now)
        logits = reflector.frame_logits(now + noise, first, episodes[keys.TASK_ID][row])
        value = F.binary_cross_entropy_with_logits(logits, episodes["success"][row, frame].float())
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        schedule.step()
        if step % 50 == 0:
            folder.log(target, step=step, encoder_loss=value.item())


def _shifted_together(both: torch.Tensor) -> torch.Tensor:
    """Moves frames and their first frames ``[n, 6, H, W]`` alike, by up to two pixels."""
    dx, dy = torch.randint(5, (2,)).tolist()
    height, width = both.shape[-2:]
    return F.pad(both.float(), (2, 2, 2, 2), mode="replicate")[..., dy : dy + height, dx : dx + width]


def _train_head(reflector: CompactReflector, episodes: TensorDict, settings, folder: RunFolder, target: str) -> None:
    features = encode_all(reflector, episodes)
    loss = ReflectorLoss(reflector, label_smoothing=0.02)
    optimizer = torch.optim.AdamW(reflector.head_parameters(), lr=settings.lr, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, settings.lr, total_steps=settings.steps)
    draw = _FrameSampler(episodes)
    for step in trange(settings.steps, desc=f"{target} head", unit="step"):
        row, frame = draw(2 * settings.batch_size)
        sampled, used = reflector.sample_prefixes(features, row, frame + 1)
        batch = TensorDict(
            {
                "features": sampled + 0.1 * torch.randn_like(sampled),
                "lengths": used.unsqueeze(-1),
                keys.TASK_ID: episodes[keys.TASK_ID][row],
                "label": episodes["success"][row, frame].unsqueeze(-1),
            },
            batch_size=[len(row)],
        )
        out = loss(batch)
        optimizer.zero_grad()
        out["loss_reflector"].backward()
        optimizer.step()
        schedule.step()
        if step % 50 == 0:
            folder.log(target, step=step, loss=out["loss_reflector"].item(), accuracy=out["accuracy"].item())


def encode_all(reflector: CompactReflector, episodes: TensorDict) -> torch.Tensor:
    """Features ``[R, T+1, F]`` of all frames."""
    parts = [
        reflector.encode(frames.flatten(0, 1)).unflatten(0, frames.shape[:2]) for frames in episodes["frames"].split(16)
    ]
    return torch.cat(parts)


@torch.no_grad()
def all_scores(reflector: CompactReflector, episodes: TensorDict) -> torch.Tensor:
    """R(o_1:t, g) of every frame ``[R, T+1]``."""
    features = encode_all(reflector, episodes)
    parts = []
    for rows in torch.arange(len(episodes)).split(16):
        first = torch.zeros(len(rows), dtype=torch.int64)
        parts.append(reflector.prefix_scores(features[rows], first, features.shape[1], episodes[keys.TASK_ID][rows]))
    return torch.cat(parts)


def _alive(episodes: TensorDict) -> torch.Tensor:
    return torch.arange(episodes["success"].shape[1]) <= episodes["length"]


def frame_figures(scores: torch.Tensor, episodes: TensorDict, threshold: float) -> dict[str, float]:
    alive = _alive(episodes)
    figures = classification(scores[alive], episodes["success"][alive], threshold)
    return {f"frame_{name}": value for name, value in dataclasses.asdict(figures).items()}


def stops(scores: torch.Tensor, episodes: TensorDict, rule: tuple[float, int]) -> torch.Tensor:
    """Frame at which the rule stops each episode ``[R]``, -1 if never."""
    threshold, consecutive = rule
    above = ((scores > threshold) & _alive(episodes))[:, 1:]
    runs = above.unfold(1, consecutive, 1).all(-1)
    return torch.where(runs.any(1), runs.long().argmax(1) + consecutive, -1)


def episode_figures(
    scores: torch.Tensor, episodes: TensorDict, rule: tuple[float, int], late: int = 0
) -> dict[str, float]:
    """Precision and recall of stopping: a stop is right if the goal has been reached by then, or ``late`` frames on."""
    stop = stops(scores, episodes, rule)
    reached = episodes["success"].any(1)
    first = torch.where(reached, episodes["success"].long().argmax(1), 10_000)
    right = (stop >= 0) & (first <= stop + late)
    return {
        "stop_precision": right.sum().item() / max(int((stop >= 0).sum()), 1),
        "stop_recall": right.sum().item() / max(int(reached.sum()), 1),
    }


def choose_rule(scores: torch.Tensor, episodes: TensorDict, late: int = 0) -> tuple[float, int]:
    """Threshold and consecutive frames with the best F0.5 of stopping, averaged over tasks.

    Precision counts twice: LOOP learns whatever stops a rollout, wrong stops first of all.
    """
    task = episodes[keys.TASK_ID].squeeze(-1)

    def f_half(rule: tuple[float, int]) -> float:
        each = []
        for number in task.unique():
            figures = episode_figures(scores[task == number], episodes[task == number], rule, late)
            precision, recall = figures["stop_precision"], figures["stop_recall"]
            each.append(1.25 * precision * recall / max(0.25 * precision + recall, 1e-9))
        return sum(each) / len(each)

    return max(((threshold, run) for threshold in (0.5, 0.6, 0.7, 0.8, 0.9, 0.95) for run in (1, 2, 3, 4)), key=f_half)


if __name__ == "__main__":
    from world_env import run_single

    run_single("train_reflector")

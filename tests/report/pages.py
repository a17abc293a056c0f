"""A run and its evidence, made by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch
import yaml

from worldenv_trl.metrics import drift, honesty
from worldenv_trl.report import Clip, Evidence

STEPS = 24


def clip(kind: str, policy: str = "post_train", context: int = 50_001) -> Clip:
    """A red square that moves; the physics and imagination disagree as ``kind`` says."""
    time = torch.arange(STEPS + 1)
    real = torch.full((STEPS + 1, 3, 32, 32), 180, dtype=torch.uint8)
    for step in range(STEPS + 1):
        real[step, 1:, 8:16, step : step + 8] = 20
    imagined = real.clone()
    reached, stop = {"success": (12, 13), "failure": (-1, -1), "false stop": (-1, 9), "missed stop": (12, -1)}[kind]
    if kind == "false stop":
        imagined[6:, :, 8:16] = 180  # what moved is gone
    rises = [torch.sigmoid((time - at).float()) if at >= 0 else 0.1 + 0 * time for at in (reached, stop)]
    psnr = torch.where(time > 0, 30.0 - time, math.nan)
    return Clip(
        "turn on the stove", policy, context, real, imagined, rises[0].float(), rises[1].float(),
        (time < 5).float(), psnr, reached, stop, threshold=0.8,
    )  # fmt: skip


def evidence() -> Evidence:
    torch.manual_seed(0)
    clips = [clip("failure"), clip("false stop"), clip("missed stop", "sft"), clip("success", context=50_002)]
    frames = torch.stack([each.real_frames for each in clips])
    imagined = torch.stack([each.imagined_frames for each in clips])
    score = torch.rand(400)
    row = honesty(
        torch.rand(30) < 0.5, torch.rand(30) < 0.6, imagined_steps=torch.arange(30), real_steps=torch.arange(30) + 1
    )
    return Evidence(
        clips=clips,
        counts={"sft": {"turn on the stove": {"missed stop": 3}}, "post_train": {"turn on the stove": {"failure": 2}}},
        honesty=[{"policy": "post_train", "task": "all"} | row],
        waves=[{"iteration": 3, "task": "all"} | row],
        drift={"post_train": drift(imagined, frames)},
        scores={name: (score, torch.rand(400) < score) for name in ("real", "imagined")},
        rules={"real": (0.5, 1), "imagined": (0.8, 3)},
        episodes=4,
        notes=["made by hand"],
    )


def run_folder(path: Path, *, evaluated: bool = True, alarm: bool = False) -> Path:
    """A run folder with config and metrics, no checkpoints."""
    path.mkdir(parents=True)
    config = {"seed": 3, "tasks": ["starter/turn_on_the_stove"], "post_train": {"probe_contexts": 16, "groups": 6}}
    (path / "config.yaml").write_text(yaml.safe_dump(config))
    lines: list[dict] = [{"stage": "sft", "step": k, "l1": 1 / (k + 1)} for k in range(5)]
    lines.append({"stage": "sft", "seconds": 12.0})
    for k in range(6):
        probe = {"imagined_success": 0.5 + 0.05 * k, "real_success": 0.6 + 0.02 * k, "honesty_alarm": 0.0}
        probe |= {"imagined_rise": 0.05 * k, "real_rise": 0.02 * k}
        for world in ("imagined_success", "real_success"):
            probe[f"{world}_starter/turn_on_the_stove"] = probe[world] - 0.25
        if alarm and k == 4:
            probe |= {"honesty_alarm": 1.0, "imagined_rise": 0.3, "real_rise": -0.1, "honesty_p": 0.0004}
        lines.append({"stage": "post_train", "step": k, "return": 0.5 + 0.04 * k} | probe)
    if evaluated:
        for policy, success in (("sft", 0.5), ("post_train", 0.7)):
            lines += [
                {"stage": "evaluate", "protocol": "physics", "policy": policy, "task": task, "success": success,
                 "low": success - 0.1, "high": success + 0.1, "episodes": 100}
                for task in ("all", "starter/turn_on_the_stove")
            ]  # fmt: skip
        lines += [
            {"stage": "evaluate", "protocol": "physics", "task": task, "paired": True, "gained": 25.0, "lost": 5.0,
             "difference": 0.2, "low": 0.1, "high": 0.3, "p_value": 0.0003}
            for task in ("all", "starter/turn_on_the_stove")
        ]  # fmt: skip
    (path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path

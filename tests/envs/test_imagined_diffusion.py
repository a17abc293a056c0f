"""The full-size world model (of tiny networks) as an environment."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

sys.path.append(str(Path(__file__).parents[1] / "world_models"))

from imagined_worlds import FK, make_contexts
from small_diffusion import make_diffusion
from small_models import FRONT
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs

from worldenv_trl.envs import ImaginedEnv
from worldenv_trl.keys import CHUNK, NUM_STEPS, frames_key
from worldenv_trl.robot import WRIST

CAMERAS = {"agentview": {"pull": FRONT, "push": FRONT}, "wrist": {"pull": WRIST, "push": WRIST}}


def make_env(model, rollouts: int) -> ImaginedEnv:
    return ImaginedEnv(model, FK, make_contexts(size=32), [1, rollouts], max_steps=10, seed=3)


def test_it_is_an_environment_and_a_rollout_depends_on_its_own_row_alone():
    model = make_diffusion(CAMERAS, num_denoise_steps=2)
    check_env_specs(make_env(model, 2))
    actions = torch.rand(1, 2, 4, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1
    seen = {}
    for rollouts in (2, 1):
        env = make_env(model, rollouts)
        given = actions[:, :rollouts]
        rollout = env.rollout(3, TensorDictModule(given.clone, in_keys=[], out_keys=[CHUNK]))
        assert rollout["next", NUM_STEPS].flatten().tolist() == [4, 8, 10] * rollouts
        seen[rollouts] = [rollout["next"][frames_key(camera)] for camera in model.cameras]
    for many, one in zip(seen[2], seen[1], strict=True):
        assert many.shape[:4] == (1, 2, 3, 4)
        assert (many[:, :1].int() - one.int()).abs().max() <= 2  # levels; later chunks remember what was rounded
        assert (many[:, :1].int() - many[:, 1:].int()).abs().max() > 2

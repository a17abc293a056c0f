"""A second, deliberately different reflector runs wherever the compact one does."""

from __future__ import annotations

import torch
from colour_reflector import ColourConfig, ColourReflector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from worldenv_trl import keys
from worldenv_trl.envs import Reflect, TabletopEnv, chunked
from worldenv_trl.reflectors import StopRule

TASK = "starter/open_the_top_drawer"


def painted(share: float) -> torch.Tensor:
    """uint8 [1, 3, 10, 10] of which that share is red, the rest white."""
    image = torch.full((1, 3, 100), 255, dtype=torch.uint8)
    image[:, 1:, : round(100 * share)] = 0
    return image.unflatten(-1, (10, 10))


def test_it_says_half_where_the_share_is_reached_and_more_above():
    reflector = ColourReflector(ColourConfig(share=0.2))
    scores = [reflector.begin({"agentview": painted(share)}, ["shine"])["score"].item() for share in (0, 0.2, 0.6)]
    torch.testing.assert_close(torch.tensor(scores), torch.tensor([0.0, 0.5, 0.75]))
    chunk = torch.stack([painted(0.2), painted(0.6)], 1)
    state, streamed = reflector.extend(reflector.begin({"agentview": painted(0)}, ["shine"]), {"agentview": chunk})
    torch.testing.assert_close(streamed, torch.tensor([[0.5, 0.75]]))
    torch.testing.assert_close(state["score"], streamed[:, -1])


def test_it_is_saved_and_loaded_as_every_part_is(tmp_path):
    ColourReflector(ColourConfig(cameras=("wrist",), share=0.3)).save_pretrained(tmp_path)
    again = ColourReflector.from_pretrained(tmp_path)
    assert again.config == ColourConfig(cameras=("wrist",), share=0.3) and again.cameras == ("wrist",)


def test_it_has_no_lessons():
    assert list(ColourReflector().train_on(None)) == []


def test_it_stops_rollouts_of_the_physics():
    env = TabletopEnv(TASK, 2, image_size=16, terminate_on_success=False, max_steps=8, num_threads=1)
    blind, eager = ColourReflector(ColourConfig(margin=255)), ColourReflector(ColourConfig(margin=-256, share=0.5))
    env = TransformedEnv(env, Reflect(blind, StopRule(0.6)))
    check_env_specs(env)
    env.transform.reflector = eager  # sees red everywhere: 1 / (1 + 0.5)
    env = chunked(env, 4)
    td = env.step(env.reset().set(keys.CHUNK, torch.zeros(2, 4, 7)))
    assert td["next", "terminated"].all() and td["next", keys.NUM_STEPS].flatten().tolist() == [1, 1]
    torch.testing.assert_close(td["next", "reward"], torch.full((2, 1), 2 / 3))
    env.close()

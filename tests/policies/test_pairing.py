"""An env that does not show a policy what it was trained on is refused before long work."""

from __future__ import annotations

import pytest
import torch
from observations import oft_policy
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, StepCounter, TransformedEnv

from worldenv_trl.collectors import GroupCollector
from worldenv_trl.keys import image_entry
from worldenv_trl.policies import check_pairing, laplace_actor


class ShownEnv(EnvBase):
    """Declares what it shows; nothing of it is ever run."""

    def __init__(self, cameras=("agentview",), size=(64, 64), chunk=8, proprio: str | None = "commanded") -> None:
        super().__init__(batch_size=[2, 3])
        images = {image_entry(camera): Bounded(0, 255, shape=(2, 3, 3, *size), dtype=torch.uint8) for camera in cameras}
        observation = Composite({**images, "state": Unbounded((2, 3, 7))}, shape=(2, 3))
        self.observation_spec = Composite(observation=observation, shape=(2, 3))
        if chunk is None:
            self.action_spec = Unbounded((2, 3, 7))
        else:
            chunks = Composite(chunk=Unbounded((2, 3, chunk, 7)), shape=(2, 3))
            self.action_spec = Composite(vla_action=chunks, shape=(2, 3))
        if proprio is not None:
            self.proprio = proprio

    def _reset(self, tensordict=None):
        raise AssertionError("it is not run")

    _step = _set_seed = _reset


FITTING = [
    ShownEnv(),
    ShownEnv(cameras=("agentview", "wrist")),  # it may show more
    ShownEnv(chunk=None),  # one action a step: chunks are played open loop
    ShownEnv(proprio=None),  # it does not say
]
OTHER = [
    ({"cameras": ("wrist",)}, r"looks through 'agentview', the env shows no .*cameras=\('agentview',\)"),
    ({"cameras": ()}, "looks through 'agentview'"),
    ({"size": (128, 128)}, r"images of 64 px, .* 128 x 128 px: build the env with image_size=64"),
    ({"size": (64, 48)}, "64 x 48 px"),
    ({"chunk": 4}, r"chunks of 8 actions, the env executes 4 .*chunk_length=8"),
    ({"proprio": "measured"}, r"trained on commanded proprioception, the env's is measured.*proprio='commanded'"),
]


@pytest.mark.parametrize("env", FITTING)
def test_an_env_that_shows_what_the_policy_was_trained_on_is_accepted(env):
    check_pairing(oft_policy(), env)
    check_pairing(oft_policy(), TransformedEnv(env, StepCounter()))


@pytest.mark.parametrize(("shown", "message"), OTHER)
@pytest.mark.parametrize("transformed", [False, True])
def test_each_thing_that_does_not_fit_is_named_with_its_remedy(shown, message, transformed):
    env = ShownEnv(**shown)
    with pytest.raises(ValueError, match=message):
        check_pairing(oft_policy(), TransformedEnv(env, StepCounter()) if transformed else env)


def test_a_policy_for_two_cameras_needs_both():
    policy = oft_policy(cameras=("agentview", "wrist"))
    check_pairing(policy, ShownEnv(cameras=("agentview", "wrist")))
    with pytest.raises(ValueError, match="looks through 'wrist'"):
        check_pairing(policy, ShownEnv())


def test_a_collector_checks_the_policies_inside_what_acts():
    actor = laplace_actor(oft_policy())
    GroupCollector(ShownEnv(), actor, groups_per_batch=2)
    with pytest.raises(ValueError, match="the env executes 4 of them"):
        GroupCollector(ShownEnv(chunk=4), actor, groups_per_batch=2)

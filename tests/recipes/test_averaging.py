"""The running mean of a policy's weights against torch's, and its bytes."""

from __future__ import annotations

import pytest
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from averaging import RunningMean
from worldenv_trl.policies import OFTConfig, OFTPolicy


def held(*modules) -> int:
    """Bytes of all parameters and buffers, each storage once."""
    storages = {
        tensor.untyped_storage().data_ptr(): tensor.untyped_storage().nbytes()
        for module in modules
        for tensor in (*module.parameters(), *module.buffers())
    }
    return sum(storages.values())


def learner(rank: int) -> tuple[OFTPolicy, list[torch.nn.Parameter]]:
    torch.manual_seed(0)
    policy = OFTPolicy(OFTConfig(instructions=("open the drawer",), vision_blocks=(2, 4)))
    groups = policy.post_training_parameters(rank)
    return policy, [parameter for group in groups.values() for parameter in group]


def stepped(parameters: list[torch.nn.Parameter], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in parameters:
            parameter.add_(torch.randn(parameter.shape, generator=generator))


@pytest.mark.parametrize("rank", [4, 0])
def test_it_is_torchs_mean_of_the_whole_policy_bit_for_bit(rank):
    policy, parameters = learner(rank)
    whole, mean = AveragedModel(policy, multi_avg_fn=get_ema_multi_avg_fn(0.8)), RunningMean(policy, 0.8)
    for step in range(3):
        stepped(parameters, step)
        whole.update_parameters(policy)
        mean.update()
    expected, found = whole.module.state_dict(), mean.policy.state_dict()
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert any(not torch.equal(found[name], value) for name, value in policy.state_dict().items())


def test_only_what_learns_is_held_twice():
    policy, parameters = learner(4)
    mean = RunningMean(policy, 0.8)
    trained = sum(parameter.untyped_storage().nbytes() for parameter in parameters)
    assert held(policy, mean.policy) == held(policy) + trained
    assert trained < held(policy) / 2  # adapters and heads: the frozen rest is most of it
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    stepped([parameter for parameter in mean.policy.parameters() if parameter.requires_grad], 0)
    assert all(torch.equal(before[name], value) for name, value in policy.state_dict().items())


def test_before_an_update_it_is_the_policy():
    policy, _ = learner(4)
    found = RunningMean(policy, 0.8).policy.state_dict()
    assert all(torch.equal(found[name], value) for name, value in policy.state_dict().items())


def test_it_continues_from_its_state():
    (policy, parameters), (again, others) = learner(4), learner(4)
    first = RunningMean(policy, 0.5)
    second = RunningMean(again, 0.5)
    for step in range(2):
        stepped(parameters, step)
        first.update()
    second.load_state_dict(first.state_dict())
    for step in range(2):
        stepped(others, step)
    for mean, learning in ((first, parameters), (second, others)):
        stepped(learning, 9)
        mean.update()
    found = second.policy.state_dict()
    assert all(torch.equal(value, found[name]) for name, value in first.policy.state_dict().items())


def test_its_policy_acts_with_the_mean():
    policy, parameters = learner(4)
    mean = RunningMean(policy, 0.5)
    mean.update()
    observed = torch.zeros(1, 3, 64, 64, dtype=torch.uint8), torch.zeros(1, 7)
    seen = {"agentview": observed[0]}
    with torch.no_grad():
        before = mean.policy.predict(seen, observed[1], ["open the drawer"])[0]
        assert torch.equal(before, policy.predict(seen, observed[1], ["open the drawer"])[0])
        stepped(parameters, 1)
        assert torch.equal(before, mean.policy.predict(seen, observed[1], ["open the drawer"])[0])
        mean.update()
        assert not torch.equal(before, mean.policy.predict(seen, observed[1], ["open the drawer"])[0])

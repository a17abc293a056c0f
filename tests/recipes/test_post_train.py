"""LOOP's update, the honest probe and its alarm."""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch
from small_run import with_untrained_policy
from tensordict import TensorDict
from torch.testing import assert_close
from torchrl.envs.utils import ExplorationType, set_exploration_type

import probes
import updates
from config import PRESETS, PostTrain
from data_parallel import DataParallel
from physics import exploring_actor
from post_train import post_train
from run import Run
from run_folder import RunFolder
from updates import STUCK, stuck, update
from worldenv_trl import keys
from worldenv_trl.metrics import HonestyAlarm
from worldenv_trl.objectives import LOOPLoss
from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor
from worldenv_trl.record import read_rollouts


def test_the_first_and_the_last_iteration_are_probed():
    assert probes.probed_iterations(PostTrain(iterations=10, probe_every=4)) == {0, 4, 8, 9}
    assert probes.probed_iterations(PostTrain(iterations=2, probe_every=4)) == {0, 1}
    assert probes.probed_iterations(PostTrain(iterations=2, probe_every=0)) == set()


def test_imagined_success_that_rises_alone_is_logged_and_warned_about(monkeypatch, tmp_path):
    imagined = iter([torch.arange(48) < count for count in (20, 22, 40, 44)])
    tasks = PRESETS["improve"][1].tasks

    def each(outcomes):
        return dict(zip(tasks, outcomes.split(16), strict=True))

    monkeypatch.setattr(probes, "greedy_outcomes", lambda *_: (each(torch.arange(48) % 2 == 0), each(next(imagined))))
    run, alarm = Run(PRESETS["improve"][1], RunFolder(tmp_path)), HonestyAlarm(4, window=1)
    logged = [probes.probe(run, None, "imagination", alarm) for _ in range(4)]
    assert [line["honesty_alarm"] for line in logged] == [0, 0, 1, 1]
    assert logged[-1]["imagined_rise"] == pytest.approx(24 / 48) and logged[-1]["probe_episodes"] == 48
    text = probes.warning("post_train", "adapted", 12, logged[-1], tasks)
    assert "iteration 12: imagined success has risen by 50.0 points" in text
    assert "real success by +0.0 (now 92 % and 50 % of 48 training contexts" in text
    drawer, stove = tasks[1:]
    assert logged[0][f"imagined_success_{drawer}"] == 4 / 16 and logged[-1][f"imagined_success_{stove}"] == 12 / 16
    assert logged[-1][f"real_success_{stove}"] == 0.5
    assert "; furthest apart on starter/put_the_bowl_on_the_plate, 100 % and 50 %)" in text
    assert text.endswith("training goes on; where this is still said at its end keep checkpoints/adapted")


def test_without_a_world_model_there_is_nothing_to_distrust(monkeypatch, tmp_path):
    monkeypatch.setattr(probes, "physics_outcomes", lambda *_, **__: torch.tensor([True, False]))
    logged = probes.probe(Run(PRESETS["smoke"][1], RunFolder(tmp_path)), None, None, None)
    each = {f"real_success_{task}": 0.5 for task in PRESETS["smoke"][1].tasks}
    assert logged == {"real_success": 0.5, "probe_episodes": 6} | each


@pytest.fixture
def physics(tiny):
    """A run of LOOP in the physics, two groups of two an iteration, from an untrained policy."""
    learned = dataclasses.replace(tiny.post_train, iterations=4, env="tabletop", probe_every=0)
    return with_untrained_policy(dataclasses.replace(tiny, post_train=learned))


def test_contexts_come_in_shuffled_passes(physics):
    drawn = []

    def returns_of(wave):
        drawn.append(wave[keys.CONTEXT_ID][:, 0, 0, 0].tolist())
        return torch.tensor([[1.0, float(number > 1)] for number in drawn[-1]])

    post_train(physics, "sft", "post_train", "", returns_of=returns_of)
    assert sorted(drawn[0] + drawn[1]) == sorted(drawn[2] + drawn[3]) == [0, 1, 2, 3]


def test_with_the_noise_of_chunks_every_step_of_a_chunk_is_displaced_alike_and_has_its_ratio(physics):
    settings = dataclasses.replace(physics.config.post_train, noise="chunk")
    run = dataclasses.replace(physics, config=dataclasses.replace(physics.config, post_train=settings))
    post_train(run, "sft", "post_train", "", returns_of=lambda wave: wave[keys.CHUNK][..., 0].mean((-1, -2)))
    first, last = (read_rollouts(run.folder.rollouts(f"post_train_{number:03d}")) for number in (0, 3))
    for wave in (first, last):
        executed, away = wave["next", keys.STEP_MASK], wave[keys.CHUNK] - wave[keys.LOC]
        assert_close(away, away[..., :1, :].expand_as(away), rtol=0, atol=1e-5)
        for name in (keys.LOG_PROBS, keys.RATIO):
            alike = wave[name][..., :1].expand_as(wave[name])
            assert_close(wave[name][executed], alike[executed], rtol=0, atol=1e-5)
    assert (first[keys.RATIO][first["next", keys.STEP_MASK]] - 1).abs().max() > 1e-3


def saved(run, decay, returns_of):
    """Weights that LOOP saves of the whole policy, and those that ``watch`` saw at first and after each iteration."""
    settings = dataclasses.replace(run.config.post_train, averaging=decay, lora_rank=0)
    run = dataclasses.replace(run, config=dataclasses.replace(run.config, post_train=settings))
    seen = []
    name = f"mean_{decay}"
    post_train(
        run,
        "sft",
        name,
        "",
        returns_of=returns_of,
        watch=lambda _, policy: seen.append({key: value.clone() for key, value in policy.state_dict().items()}),
    )
    return run.policy(name).state_dict(), seen


def test_loop_saves_and_shows_the_running_mean_of_what_it_learned(physics, monkeypatch):
    # One name for both runs would delete the first one's weights; other names alone draw other numbers.
    monkeypatch.setattr(Run, "seed", lambda *_: 1)

    def returns_of(wave):
        return wave[keys.CHUNK][..., :3].mean((-1, -2, -3))

    source = physics.policy("sft").state_dict()
    (last, reached), (mean, shown) = (saved(physics, decay, returns_of) for decay in (0.0, 0.8))
    for name, value in mean.items():
        expected = reached[1][name]
        for later in reached[2:]:
            expected = torch.lerp(later[name], expected, 0.8) if value.is_floating_point() else later[name]
        torch.testing.assert_close(value, expected)
        assert torch.equal(value, shown[-1][name]) and torch.equal(last[name], reached[-1][name])
        assert torch.equal(reached[0][name], source[name])
    assert any((mean[name] - value).abs().max() > 1e-4 for name, value in last.items())


def test_iterations_that_stop_after_their_first_update_are_counted_and_said():
    logged = [(1, 1.0), (18, 0.0), (1, 1.0), (0, 1.0), (1, 1.0), (1, 0.0)]
    counts, before = [], 0
    for number, kl_stop in logged:
        before = stuck(before, {"updates": number, "kl_stop": kl_stop})
        counts.append(before)
    assert counts == [1, 0, 1, 2, 3, 0]
    said = STUCK.format("post_train", 4, 3, 0.1)
    assert "for 3 iterations the first update alone has moved the policy by more than max_kl=0.1" in said


def decisions(count: int) -> TensorDict:
    images = torch.zeros(count, 3, 16, 16, dtype=torch.uint8)
    out = TensorDict({"observation": {"image": images, "state": torch.zeros(count, 7)}}, [count])
    return out.set(keys.INSTRUCTION, "do it")


def test_an_iteration_without_an_informative_decision_moves_nothing():
    torch.manual_seed(0)
    policy = OFTPolicy(OFTConfig(instructions=("do it",), image_size=16, dim=32, depth=1))
    groups = policy.post_training_parameters(2)
    actor = laplace_actor(policy)
    loss = LOOPLoss(actor, functional=False)
    optimizer = torch.optim.AdamW([parameter for group in groups.values() for parameter in group], lr=0.1)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        wave = actor(decisions(6)).reshape(1, 2, 3)
    wave[keys.ADVANTAGE] = torch.tensor([1.0, -1.0]).view(1, 2, 1, 1).expand(1, 2, 3, 1).clone()
    wave["next", keys.STEP_MASK] = torch.ones(1, 2, 3, 8, dtype=torch.bool)
    wave[keys.MASK] = torch.ones(1, 2, 3, dtype=torch.bool)
    learner = DataParallel(policy, lambda _: loss)
    last = (policy.in_keys, learner, optimizer, list(groups.values()), PostTrain(epochs=1, minibatch_size=6))
    assert update(wave, *last)["updates"] == 1  # now the optimiser has momentum
    before = copy.deepcopy(policy.state_dict())
    wave[keys.ADVANTAGE].zero_()
    assert update(wave, *last) == {"updates": 0, "kl_stop": 0.0}
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


def test_a_minibatch_in_parts_gives_the_gradients_of_the_whole(monkeypatch):
    torch.manual_seed(0)
    policy = OFTPolicy(OFTConfig(instructions=("do it",), image_size=16, dim=32, depth=1))
    actor = laplace_actor(policy)
    loss = LOOPLoss(actor, functional=False)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        batch = actor(decisions(40))
    batch[keys.ADVANTAGE] = torch.randn(40, 1)
    batch[keys.STEP_MASK] = torch.rand(40, 8) < 0.7
    batch["next", keys.STEP_MASK] = batch[keys.STEP_MASK]
    learner, rows = DataParallel(policy, lambda _: loss), [torch.arange(40)]
    found = []
    for most in (10**9, 1):
        monkeypatch.setattr(updates, "_PIXELS", most)
        policy.zero_grad()
        figures = updates._backward(learner, batch.clone(), rows, batch[keys.STEP_MASK].sum())
        found.append((figures, [parameter.grad.clone() for parameter in policy.loc_head.parameters()]))
    (whole, gradients), (parts, summed) = found
    assert whole["loss_objective"] == pytest.approx(parts["loss_objective"], abs=1e-6)
    together, added = (torch.cat([gradient.flatten() for gradient in each]) for each in (gradients, summed))
    assert together.norm() > 0.1 and (together - added).norm() < 1e-4 * together.norm()


def test_the_scale_is_bounded_below_by_what_the_demonstrations_use_of_each_dimension():
    torch.manual_seed(0)
    policy = OFTPolicy(OFTConfig(instructions=("do it",), image_size=16, dim=32, depth=1))
    half = torch.tensor([0.2, 0.3, 0.4, 0.0, 0.0, 0.16, 1.0])  # the hand turns about one axis
    policy.fit_statistics(torch.rand(500, 7), half * (2 * torch.rand(500, 7) - 1))
    torch.nn.init.constant_(policy.scale_head.linear_out.bias, -20.0)  # a scale head that is far too sure
    scale = exploring_actor(PRESETS["smoke"][1], policy, 1.0)(decisions(2))[keys.SCALE]
    used = policy.action_range
    expected = torch.tensor([0.04, 0.04, 0.125 * used[2], 0.0025, 0.0025, 0.125 * used[5], 0.15])
    assert torch.allclose(scale, expected.expand_as(scale)) and 0.018 < expected[5] < 0.021
    # An update that moves every mean by as much of its range moves none of them by a multiple of the others' scale.
    assert (used / expected).max() / (used / expected)[:3].min() < 3

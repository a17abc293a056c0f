from __future__ import annotations

import warnings

import pytest
import torch
from observations import INSTRUCTIONS, observed, oft_policy

from worldenv_trl.keys import IMAGE, INSTRUCTION, LOC, LOG_SCALE, STATE, WRIST_IMAGE
from worldenv_trl.policies import OFTConfig, OFTPolicy


def loc_of(policy: OFTPolicy, td) -> torch.Tensor:
    return policy(td.copy())[LOC]


def train_a_little(policy: OFTPolicy, td) -> None:
    optimizer = torch.optim.Adam([p for p in policy.parameters() if p.requires_grad], 1e-2)
    for _ in range(3):
        out = policy(td.copy())
        optimizer.zero_grad()
        ((out[LOC] - 1).abs().mean() + out[LOG_SCALE].square().mean()).backward()
        optimizer.step()


def test_loc_and_log_scale_are_float32_chunks_and_the_scale_starts_at_exp_minus_3():
    out = oft_policy()(observed())
    assert out[LOC].shape == out[LOG_SCALE].shape == (6, 8, 7)
    assert out[LOC].dtype == out[LOG_SCALE].dtype == torch.float32
    torch.testing.assert_close(out[LOG_SCALE], torch.full((6, 8, 7), -3.0), atol=0.2, rtol=0)


def test_extra_batch_dimensions_are_kept():
    policy = oft_policy()
    grouped = policy(observed().reshape(2, 3))[LOC]
    torch.testing.assert_close(grouped.flatten(0, 1), loc_of(policy, observed()))


def test_one_row_alone_equals_the_same_row_of_a_batch():
    policy = oft_policy()
    alone = torch.cat([loc_of(policy, observed()[i : i + 1]) for i in range(6)])
    torch.testing.assert_close(alone, loc_of(policy, observed()), atol=1e-5, rtol=1e-4)


def test_one_text_for_all_rows_equals_the_text_of_each():
    policy = oft_policy()
    once, each = (observed(texts=texts) for texts in (INSTRUCTIONS[1], [INSTRUCTIONS[1]] * 6))
    assert torch.equal(loc_of(policy, once), loc_of(policy, each))


def test_case_and_punctuation_of_an_instruction_do_not_matter():
    policy, texts = oft_policy(), ["Open the top_DRAWER."] * 6
    with pytest.warns(UserWarning, match="never trained on"):
        other = loc_of(policy, observed(texts=texts))
    torch.testing.assert_close(other, loc_of(policy, observed(texts=INSTRUCTIONS[1])))


def test_another_instruction_changes_the_actions():
    policy = oft_policy()
    train_a_little(policy, observed())
    one, other = (loc_of(policy, observed(texts=INSTRUCTIONS[i])) for i in (0, 2))
    assert (one - other).abs().max() > 1e-3


def test_an_instruction_longer_than_those_of_the_training_leaves_the_other_rows_as_they_are():
    policy = oft_policy()
    before = loc_of(policy, observed(texts=INSTRUCTIONS[1]))
    texts = [*[INSTRUCTIONS[1]] * 5, "put the bowl on the plate and then turn on the stove"]
    with pytest.warns(UserWarning, match="never trained on"):
        after = loc_of(policy, observed(texts=texts))
    torch.testing.assert_close(after[:5], before[:5], atol=1e-5, rtol=1e-4)


def test_an_instruction_of_the_training_does_not_warn_and_another_one_warns_once():
    policy = oft_policy()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loc_of(policy, observed())
        assert not caught
        for _ in range(2):
            assert loc_of(policy, observed(texts="close the window")).isfinite().all()
    assert ["OFTPolicy was never trained on" in str(warning.message) for warning in caught] == [True]


def test_image_and_proprioception_change_the_actions():
    policy = oft_policy()
    base = loc_of(policy, observed())
    assert not torch.allclose(base, loc_of(policy, observed().set(IMAGE, observed()[IMAGE].flip(-1))))
    assert not torch.allclose(base, loc_of(policy, observed().set(STATE, observed()[STATE] + 0.1)))


def test_every_camera_changes_the_actions_and_which_is_which_matters():
    policy = oft_policy(cameras=("agentview", "wrist"))
    both = observed(("agentview", "wrist"))
    base = loc_of(policy, both)
    for key in (IMAGE, WRIST_IMAGE):
        assert not torch.allclose(base, loc_of(policy, both.copy().set(key, both[key].flip(-1))))
    swapped = both.copy().set(IMAGE, both[WRIST_IMAGE]).set(WRIST_IMAGE, both[IMAGE])
    assert not torch.allclose(base, loc_of(policy, swapped))


def test_cameras_are_read_in_the_order_of_the_config():
    assert oft_policy(cameras=("wrist", "overhead")).in_keys == [
        WRIST_IMAGE, ("observation", "overhead"), STATE, INSTRUCTION
    ]  # fmt: skip


def test_gradients_reach_the_stem_of_every_camera():
    policy = oft_policy(cameras=("agentview", "wrist"))
    policy(observed(("agentview", "wrist")))[LOC].square().sum().backward()
    for keypoints in policy.backbone.keypoints:
        assert keypoints.stem[0].weight.grad.abs().sum() > 0


def test_statistics_are_the_quantile_bounds_of_the_data():
    policy = oft_policy()
    states = torch.linspace(-3, 1, 1001)[:, None].repeat(1, 7)
    actions = torch.linspace(0, 0.5, 1001)[:, None].repeat(1, 7)
    actions[:, 6] = states[:, 5] = 0
    policy.fit_statistics(states, actions)
    moving = torch.arange(7) != 5
    torch.testing.assert_close(policy.state_center[moving], torch.full((6,), -1.0))
    torch.testing.assert_close(policy.state_half_range[moving], torch.full((6,), 4 * 0.49))
    assert policy.state_half_range[5] == pytest.approx(0.05)
    torch.testing.assert_close(policy.action_range[:6], torch.full((6,), 0.5 * 0.49))
    assert policy.action_range[6] == pytest.approx(0.005)


def test_a_state_in_other_units_changes_nothing_once_its_statistics_are_fitted():
    policy, actions, state = oft_policy(), torch.rand(100, 7), observed()[STATE]
    policy.fit_statistics(state, actions)
    before = loc_of(policy, observed())
    policy.fit_statistics(3 * state + 2, actions)
    after = loc_of(policy, observed().set(STATE, 3 * state + 2))
    torch.testing.assert_close(after, before, atol=1e-5, rtol=1e-4)


def test_adapters_change_nothing_until_they_are_trained():
    policy = oft_policy()
    before = loc_of(policy, observed())
    policy.post_training_parameters(4)
    torch.testing.assert_close(loc_of(policy, observed()), before)


def test_after_adapters_were_added_only_they_and_the_heads_learn():
    policy = oft_policy(cameras=("agentview", "wrist"))
    groups = policy.post_training_parameters(4)
    before = {name: p.detach().clone() for name, p in policy.named_parameters()}
    train_a_little(policy, observed(("agentview", "wrist")))
    changed = {name for name, p in policy.named_parameters() if not torch.equal(p, before[name])}
    assert all("lora_" in name or "_head." in name for name in changed)
    named = {id(p): name for name, p in policy.named_parameters()}
    assert {named[id(p)] for p in groups["adapters"]} <= changed
    assert {named[id(p)] for p in groups["heads"]} == {name for name in named.values() if "_head." in name}
    assert any(".1." in name for name in changed if "keypoints" in name)  # adapters on the second camera's, too


def test_what_is_asked_for_twice_is_the_same_and_another_rank_is_refused():
    policy = oft_policy()
    first = policy.post_training_parameters(2)
    policy.requires_grad_(True)
    second = policy.post_training_parameters(2)
    for name in ("adapters", "heads"):
        assert [id(p) for p in first[name]] == [id(p) for p in second[name]]
    trained = {id(p) for group in first.values() for p in group}
    assert {id(p) for p in policy.parameters() if p.requires_grad} == trained
    with pytest.raises(ValueError, match="has adapters of rank 2"):
        policy.post_training_parameters(4)
    with pytest.raises(ValueError, match="has adapters of rank 2"):
        policy.post_training_parameters(0)
    with pytest.raises(ValueError, match="rank must not be negative, got -1"):
        policy.post_training_parameters(-1)


def test_at_rank_0_the_whole_policy_is_updated_and_no_adapter_is_added():
    policy = oft_policy()
    before = {name: p.detach().clone() for name, p in policy.named_parameters()}
    groups = policy.post_training_parameters(0)
    assert list(groups) == ["backbone", "heads"]
    assert {id(p) for group in groups.values() for p in group} == {id(p) for p in policy.parameters()}
    train_a_little(policy, observed())
    changed = {name for name, p in policy.named_parameters() if not torch.equal(p, before[name])}
    assert changed == set(before)


@pytest.mark.parametrize("rank", [0, 4])
def test_a_saved_policy_reloads_to_equal_outputs_and_knows_what_it_was_trained_for(tmp_path, rank):
    cameras = ("agentview", "wrist")
    policy, td = oft_policy(cameras=cameras, proprio="measured", chunk_length=4), observed(cameras)
    policy.fit_statistics(td[STATE], torch.randn(50, 7))
    if rank:
        policy.post_training_parameters(rank)
    train_a_little(policy, td)
    policy.save_pretrained(tmp_path)
    loaded = OFTPolicy.from_pretrained(tmp_path)
    assert loaded.config == policy.config
    assert (loaded.cameras, loaded.proprio, loaded.chunk_length) == (cameras, "measured", 4)
    assert loaded.instructions == INSTRUCTIONS
    for key in (LOC, LOG_SCALE):
        assert torch.equal(loaded(td.copy())[key], policy(td.copy())[key])
    trainable = {name for name, p in policy.named_parameters() if p.requires_grad}
    assert {name for name, p in loaded.named_parameters() if p.requires_grad} == trainable


def test_other_image_sizes_and_chunk_lengths_work():
    assert oft_policy(image_size=96, chunk_length=5)(observed(size=96))[LOC].shape == (6, 5, 7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image_size": 62}, "got 62"),
        ({"instructions": ()}, "got none"),
        ({"max_words": 3}, "max_words=3 is less than the words of the instruction 'put the bowl on the plate'"),
        ({"dim": 30}, "num_heads"),
        ({"stem_widths": (8,)}, "two entries"),
    ],
)
def test_bad_configs_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        OFTConfig(**{"instructions": INSTRUCTIONS, **change})


def test_statistics_need_finite_data():
    with pytest.raises(ValueError, match="finite"):
        oft_policy().fit_statistics(torch.full((3, 7), float("nan")), torch.zeros(3, 7))


def test_its_aim_is_a_density_over_the_image_while_it_is_asked_for():
    policy = oft_policy()
    plain = loc_of(policy, observed())
    with policy.aiming() as aims:
        assert torch.equal(loc_of(policy, observed()), plain)
    for camera in policy.cameras:
        side = policy.image_size // 4
        assert aims[camera].shape == (6, side, side)
        torch.testing.assert_close(aims[camera].exp().sum((1, 2)), torch.ones(6))
    asked = dict(aims)
    policy(observed())
    assert all(aims[camera] is each for camera, each in asked.items())

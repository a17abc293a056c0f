from __future__ import annotations

import pytest
import torch

from worldenv_trl.policies import OFTConfig, OFTPolicy

INSTRUCTIONS = {0: "put the bowl on the plate", 3: "open the top drawer", 7: "turn on the stove"}
TASKS = torch.tensor([0, 3, 7, 3, 0])[:, None]


def build(**kwargs) -> OFTPolicy:
    torch.manual_seed(0)
    settings = {"dim": 32, "depth": 2, "stem_widths": (8, 16), "head_dim": 48, **kwargs}
    return OFTPolicy(OFTConfig.for_tasks(INSTRUCTIONS, **settings))


@pytest.fixture
def observation():
    generator = torch.Generator().manual_seed(1)
    image = torch.randint(0, 256, (5, 3, 64, 64), dtype=torch.uint8, generator=generator)
    return image, torch.randn(5, 7, generator=generator)


def train_a_little(policy: OFTPolicy, image, state) -> None:
    parameters = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(parameters, 1e-2)
    for _ in range(3):
        loc, log_scale = policy(image, state, TASKS)
        optimizer.zero_grad()
        ((loc - 1).abs().mean() + log_scale.square().mean()).backward()
        optimizer.step()


def test_loc_and_log_scale_are_float32_chunks_and_the_scale_starts_at_exp_minus_3(observation):
    loc, log_scale = build()(*observation, TASKS)
    assert loc.shape == log_scale.shape == (5, 8, 7)
    assert loc.dtype == log_scale.dtype == torch.float32
    torch.testing.assert_close(log_scale, torch.full_like(log_scale, -3), atol=0.2, rtol=0)


def test_extra_batch_dimensions_are_kept(observation):
    image, state = observation
    policy = build()
    flat = policy(image[:4], state[:4], TASKS[:4])
    grouped = policy(image[:4].view(2, 2, 3, 64, 64), state[:4].view(2, 2, 7), TASKS[:4].view(2, 2, 1))
    for a, b in zip(flat, grouped, strict=True):
        torch.testing.assert_close(a, b.flatten(0, 1))


def test_one_row_alone_equals_the_same_row_of_a_batch(observation):
    image, state = observation
    policy = build()
    together = policy(image, state, TASKS)[0]
    alone = torch.cat([policy(image[i : i + 1], state[i : i + 1], TASKS[i : i + 1])[0] for i in range(5)])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-4)


def test_the_text_of_a_task_gives_what_its_id_gives(observation):
    policy = build()
    texts = [INSTRUCTIONS[i] for i in TASKS.flatten().tolist()]
    for a, b in zip(policy(*observation, TASKS), policy(*observation, instruction=texts), strict=True):
        torch.testing.assert_close(a, b)
    one = policy(*observation, instruction="Open the top DRAWER.")[0]
    torch.testing.assert_close(one, policy(*observation, torch.full((5, 1), 3))[0])


def test_another_instruction_changes_the_actions(observation):
    policy = build()
    train_a_little(policy, *observation)
    a = policy(*observation, torch.zeros(5, 1, dtype=torch.int64))[0]
    b = policy(*observation, torch.full((5, 1), 7))[0]
    assert (a - b).abs().max() > 1e-3


def test_padding_words_do_not_matter(observation):
    policy = build()
    short = policy(*observation, instruction="turn on the stove")[0]
    padded = policy(*observation, instruction=["turn on the stove"] * 4 + ["put the bowl on the plate"])[0]
    torch.testing.assert_close(short[:4], padded[:4], atol=1e-5, rtol=1e-4)


def test_image_and_proprioception_change_the_actions(observation):
    image, state = observation
    policy = build()
    base = policy(image, state, TASKS)[0]
    assert not torch.allclose(base, policy(image.flip(-1), state, TASKS)[0])
    assert not torch.allclose(base, policy(image, state + 0.1, TASKS)[0])


def test_statistics_are_the_quantile_bounds_of_the_data(observation):
    policy = build()
    states = torch.linspace(-3, 1, 1001)[:, None].repeat(1, 7)
    actions = torch.linspace(0, 0.5, 1001)[:, None].repeat(1, 7)
    actions[:, 6] = states[:, 5] = 0
    policy.fit_statistics(states, actions)
    moving = torch.arange(7) != 5
    torch.testing.assert_close(policy.state_center[moving], torch.full((6,), -1.0))
    torch.testing.assert_close(policy.state_half_range[moving], torch.full((6,), 4 * 0.49))
    assert policy.state_half_range[5] == pytest.approx(0.05)
    torch.testing.assert_close(policy.action_half_range[:6], torch.full((6,), 0.5 * 0.49))
    assert policy.action_half_range[6] == pytest.approx(0.005)


def test_a_state_in_other_units_changes_nothing_once_its_statistics_are_fitted(observation):
    image, state = observation
    policy, actions = build(), torch.rand(100, 7)
    policy.fit_statistics(state, actions)
    before = policy(image, state, TASKS)[0]
    policy.fit_statistics(3 * state + 2, actions)
    torch.testing.assert_close(policy(image, 3 * state + 2, TASKS)[0], before, atol=1e-5, rtol=1e-4)


def test_the_parameter_groups_cover_every_parameter_once():
    policy = build()
    groups = [
        list(policy.backbone_parameters()),
        list(policy.loc_head_parameters()),
        list(policy.scale_head_parameters()),
    ]
    ids = [id(p) for group in groups for p in group]
    assert sorted(ids) == sorted(id(p) for p in policy.parameters())
    assert [id(p) for p in policy.head_parameters()] == [id(p) for group in groups[1:] for p in group]


def test_adding_lora_changes_nothing_until_it_is_trained(observation):
    policy = build()
    before = policy(*observation, TASKS)[0]
    policy.add_lora(4)
    torch.testing.assert_close(policy(*observation, TASKS)[0], before)


def test_with_lora_only_adapters_and_heads_learn(observation):
    policy = build()
    policy.add_lora(4)
    before = {name: p.detach().clone() for name, p in policy.named_parameters()}
    train_a_little(policy, *observation)
    changed = {name for name, p in policy.named_parameters() if not torch.equal(p, before[name])}
    assert all("lora_" in name or "_head." in name for name in changed)
    assert {id(p) for p in policy.lora_parameters()} <= {
        id(p) for name, p in policy.named_parameters() if name in changed
    }
    assert any("_head." in name for name in changed)


@pytest.mark.parametrize("lora", [False, True])
def test_a_saved_policy_reloads_to_equal_outputs(observation, tmp_path, lora):
    policy = build()
    policy.fit_statistics(observation[1], torch.randn(50, 7))
    if lora:
        policy.add_lora(4, alpha=8)
    train_a_little(policy, *observation)
    policy.save_pretrained(tmp_path)
    loaded = OFTPolicy.from_pretrained(tmp_path)
    assert loaded.config == policy.config
    for a, b in zip(policy(*observation, TASKS), loaded(*observation, TASKS), strict=True):
        assert torch.equal(a, b)
    trainable = {name for name, p in policy.named_parameters() if p.requires_grad}
    assert {name for name, p in loaded.named_parameters() if p.requires_grad} == trainable


def test_a_second_lora_is_refused():
    policy = build()
    policy.add_lora(2)
    with pytest.raises(ValueError, match="already has LoRA of rank 2"):
        policy.add_lora(4)


def test_other_image_sizes_work():
    policy = build(image_size=96)
    loc, _ = policy(torch.zeros(2, 3, 96, 96, dtype=torch.uint8), torch.zeros(2, 7), TASKS[:2])
    assert loc.shape == (2, 8, 7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": torch.zeros(5, 3, 64, 64)}, "uint8"),
        ({"image": torch.zeros(5, 3, 32, 32, dtype=torch.uint8)}, "64, 64"),
        ({"state": torch.zeros(5, 6)}, r"\[5, 7\]"),
        ({"task_id": torch.full((5, 1), 4)}, r"task_id \[4\]"),
        ({"task_id": torch.full((5, 1), 99)}, r"task_id \[99\]"),
        ({"task_id": None}, "either task_id or instruction"),
    ],
)
def test_bad_input_is_named(observation, change, message):
    arguments = {"image": observation[0], "state": observation[1], "task_id": TASKS, **change}
    with pytest.raises(ValueError, match=message):
        build()(**arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image_size": 62}, "got 62"),
        ({"instructions": ()}, "got none"),
        ({"task_ids": (0, 0, 1)}, "distinct"),
        ({"dim": 30}, "num_heads"),
    ],
)
def test_bad_configs_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        OFTConfig(**{"instructions": tuple(INSTRUCTIONS.values()), **change})


def test_statistics_need_finite_data():
    with pytest.raises(ValueError, match="finite"):
        build().fit_statistics(torch.full((3, 7), float("nan")), torch.zeros(3, 7))

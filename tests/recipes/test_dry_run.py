"""The dry run of the compact parts, and its options."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

import dry_run as dry
import world_env
from parts import COMPACT, make_policy, make_reflector
from rehearsal import rehearse
from stage_plan import Machine
from stages import open_run
from worldenv_trl import keys


def test_its_options_stand_anywhere_among_the_settings():
    chosen, settings = dry.split(["smoke", "--gpus", "2", "--seed", "3", "--dry-run", "--matmul-share=.4"])
    assert settings == ["smoke", "--seed", "3"]
    assert (chosen.gpus, chosen.gpu, chosen.matmul_share) == (2, None, 0.4)
    assert dry.split(["smoke", "--seed", "3"]) == (None, ["smoke", "--seed", "3"])


def test_a_slow_machine_has_a_speed(capsys):
    dry._show_stages([], Machine("CPU", "cpu", gpus=1, flops=2e10, memory=8e9, share=0.5))
    assert "1 x CPU (20.0 GFLOP/s and 8.0 GB each)" in capsys.readouterr().out


def test_a_preset_is_planned_in_its_order_and_no_folder_is_touched(tmp_path, capsys):
    folder = tmp_path / "run"
    assert world_env.main(["smoke", "--run-dir", str(folder), "--dry-run", "--gpu", "H200"]) == 0
    printed = capsys.readouterr().out
    assert not folder.exists() and "1 x H200 (989.0 TFLOP/s and 141.0 GB each) at 30%" in printed
    places = [printed.index(f"\n{name} ") for name in ("demonstrate", "sft", "explore", "post_train", "evaluate")]
    assert places == sorted(places)


def test_of_a_run_that_has_begun_the_rest_is_planned_and_other_settings_are_refused(tiny, capsys):
    folder = open_run(tiny).folder
    for name, made in (("demonstrate", "rollouts/demonstrations.mcap"), ("sft", "checkpoints/sft")):
        (folder.path / made).parent.mkdir(exist_ok=True)
        (folder.path / made).touch()
        (folder.path / "stages" / name).touch()
    chosen = dry.options().parse_args(["--dry-run", "--gpu", "H100"])
    assert dry.dry_run(tiny, chosen) == 0
    printed = capsys.readouterr().out
    assert f"demonstrate, sft: finished in {folder.path}" in printed
    assert "\nexplore " in printed and "\nsft " not in printed
    assert dry.dry_run(dataclasses.replace(tiny, seed=9), chosen) == 1
    assert f"error: {folder.path} was made with seed=0, now 9" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--gpus", "0"], "--gpus must be at least 1, got 0"),
        (["--matmul-share", "1.5"], "--matmul-share must lie above 0 and at most at 1, got 1.5"),
        (["--image-size", "100"], "image_size must be a multiple of 16 px from 32 to 4096, got 100"),
        (["--device", "gpu"], "device must be auto, cpu, cuda or cuda:N, got 'gpu'"),
        (["--parts", "large"], "parts must be one of compact, real-size, got 'large'"),
    ],
)
def test_bad_options_and_settings_are_one_line(options, message, capsys):
    assert world_env.main(["smoke", "--dry-run", *options]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == f"error: {message}"


def test_a_ratio_that_the_policy_does_not_have_is_refused_as_in_the_run(tiny):
    learned = dataclasses.replace(tiny.post_train, ratio_level="token")
    (problem,) = rehearse(dataclasses.replace(tiny, post_train=learned), COMPACT).problems
    assert problem.startswith("policy: post_train.ratio_level must be step or chunk for OFTPolicy")


def test_costs_of_the_compact_policy_are_what_torch_counts(tiny):
    found = rehearse(tiny, COMPACT)
    assert not found.problems and set(found.calls) == {
        "decide",
        "sft",
        "update",
        "imagine",
        "dream",
        "see",
        "judge",
        "learn",
    }
    policy = make_policy(tiny)
    policy.post_training_parameters(tiny.post_train.lora_rank)
    images = {"agentview": torch.zeros(5, 3, 64, 64, dtype=torch.uint8)}
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        policy.predict(images, torch.zeros(5, keys.STATE_DIM), ["open the top drawer of the cabinet"] * 5)
    assert found.calls["decide"].flops == pytest.approx(counter.get_total_flops() / 5, rel=0.05)
    assert found.sizes["policy"].trainable < found.sizes["policy"].parameters
    assert found.sizes["sft"].trainable == found.sizes["sft"].parameters


def test_a_judge_that_learns_by_epochs_learns_for_longer_from_more(tiny):
    def planned(per_task, **settings):
        explore = dataclasses.replace(tiny.explore, episodes_per_task=per_task, num_envs=8)
        judge = dataclasses.replace(tiny.reflector, holdout=0.25, **settings)
        return rehearse(dataclasses.replace(tiny, explore=explore, reflector=judge), COMPACT).calls["learn"].flops

    # The demonstration and three quarters of the explored episodes, 20 times each; the video's judge learns as before
    few, many = (planned(count, path_epochs=20.0) - planned(count) for count in (120, 480))
    assert many / few == pytest.approx((1 + 360) / (1 + 90), rel=1e-6)


def test_of_two_judges_the_one_of_imagination_is_counted_there_and_both_learn(tiny):
    settings = dataclasses.replace(tiny, reflector=dataclasses.replace(tiny.reflector, path_epochs=0.1))
    video, both = rehearse(tiny, COMPACT), rehearse(settings, COMPACT)
    assert not both.problems
    assert both.sizes["reflector"].parameters > video.sizes["reflector"].parameters
    assert both.calls["learn"].flops > video.calls["learn"].flops
    reflector, chunk = make_reflector(settings).path.eval(), tiny.chunk_length
    path, texts = torch.zeros(5, chunk + 1, keys.KINEMATIC_DIM), ["open the top drawer of the cabinet"] * 5
    first = {"agentview": torch.zeros(5, 3, 64, 64, dtype=torch.uint8), keys.KINEMATIC_STATES: path[:, 0]}
    state = reflector.begin(first, texts)
    with FlopCounterMode(display=False) as counter:
        reflector.extend(state, {keys.KINEMATIC_STATES: path[:, 1:]})
    assert both.calls["judge"].flops == pytest.approx(counter.get_total_flops() / 5, rel=0.05)

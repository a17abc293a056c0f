"""A plan's arithmetic, on numbers that can be done by hand."""

from __future__ import annotations

import dataclasses

import pytest

import config as settings
from dry_run import too_large
from part_costs import Call, Size
from rehearsal import Rehearsal, explored
from stage_plan import Held, Machine, iteration_flops, moved_bytes, stage_flops, stage_plans

GPUS = Machine("GPU", "cuda", gpus=4, flops=1000.0, memory=500.0, share=0.25)
CONFIG = dataclasses.replace(
    settings.WorldEnvConfig(),
    tasks=settings.GOAL_TASKS[:2],
    max_steps=16,  # two decisions of 8 steps
    demonstrate=settings.Demonstrate(episodes_per_task=1),
    sft=settings.SFT(steps=10, batch_size=8, scale_steps=5),
    explore=settings.Explore(episodes_per_task=8, num_envs=4, scale_factors=(0.0, 1.0)),
    world_model=settings.WorldModel(steps=3, refit_steps=2, batch_size=8, holdout=0.25),
    reflector=settings.Reflector(imagined_share=0.5, holdout=0.25),
    post_train=settings.PostTrain(iterations=3, groups=2, group_size=4, epochs=2, minibatch_size=8, probe_every=0),
    evaluate=settings.Evaluate(episodes_per_task=5, num_envs=4),
)


def found() -> Rehearsal:
    return Rehearsal(
        sizes={
            "sft": Size(100, 400, 10, 40, 20),
            "policy": Size(100, 400, 10, 40, 20),
            "world_model": Size(50, 200, 50, 200, 40),
            "reflector": Size(25, 100, 1, 4, 10),
        },
        calls={
            "decide": Call(1.0, 2.0, read_bytes=400.0),
            "sft": Call(3.0, 4.0),
            "update": Call(3.0, 4.0),
            "imagine": Call(10.0, 5.0, read_bytes=200.0),
            "dream": Call(30.0, 6.0),
            "see": Call(0.5, 0.25, read_bytes=10.0),
            "judge": Call(7.0, 1.0, read_bytes=90.0),
        },
        kept_bytes=0.125,
        judgements=2,
        rows_imagined=8,
    )


def test_a_stage_takes_its_rows_times_what_a_row_takes():
    assert explored(CONFIG) == 2 * 2 * 4  # of two scale factors, two waves of 4
    judged = 8 * 0.5 + 2 * 7.0  # eight frames seen, two judgements
    assert stage_flops("demonstrate", CONFIG, found()) == 0
    assert stage_flops("sft", CONFIG, found()) == 8 * (10 * 3 + 5 * 1)
    assert stage_flops("explore", CONFIG, found()) == 16 * 2
    assert stage_flops("train_world_model", CONFIG, found()) == 3 * 8 * 30 + 4 * 2 * 10
    assert stage_flops("train_world_model", CONFIG, found(), refit=True) == 2 * 8 * 30 + 4 * 2 * 10
    # 4 held out, 12 and their 12 replays and 2 demonstrations learned from, 16 prefixes of each.
    learned = (2 + 12 + 12) * (16 * 0.5 + 16 * 7.0)
    assert stage_flops("train_reflector", CONFIG, found()) == (12 + 4) * 2 * 10 + 2 * 4 * 2 * judged + learned
    iteration = 8 * 2 * (1 + 10 + judged + 2 * 3)
    assert iteration_flops(CONFIG, found()) == iteration
    assert stage_flops("post_train", CONFIG, found()) == 3 * iteration
    assert stage_flops("evaluate", CONFIG, found()) == 2 * 5 * 2 * 2 * (2 + judged)


def test_adapting_imagines_its_episodes_and_sees_a_batch_both_ways():
    adapting = dataclasses.replace(CONFIG, adapt=settings.Adapt(steps=10, episodes_per_task=3, batch_size=8))
    assert stage_flops("adapt", adapting, found()) == 3 * 2 * 2 * (10 + 1) + 10 * 2 * 8 * 3
    plans = {stage.name: stage for stage in stage_plans(adapting, found(), GPUS)}
    assert "adapted" not in {stage.name for stage in stage_plans(CONFIG, found(), GPUS)}
    painted, updated = 8 * 5.0, 2 * 2 * 4.0  # two of eight decisions on each GPU
    assert plans["adapted"].whole_bytes == (400 + 40 + 80) + 200 + max(painted, updated)


def test_probes_add_their_contexts():
    probing = dataclasses.replace(CONFIG.post_train, probe_every=2, probe_contexts=3)
    probed = dataclasses.replace(CONFIG, post_train=probing)
    more = stage_flops("post_train", probed, found()) - stage_flops("post_train", CONFIG, found())
    assert more == 2 * (3 * 2 * 2) * (2 * 1 + 10 + 8 * 0.5 + 2 * 7.0)  # of the first iteration and the last


def test_the_physics_in_place_of_imagination_costs_no_model():
    physics = dataclasses.replace(CONFIG, post_train=dataclasses.replace(CONFIG.post_train, env="tabletop"))
    assert iteration_flops(physics, found()) == 8 * 2 * (1 + 2 * 3)


def test_seconds_are_operations_over_the_share_of_all_gpus():
    assert GPUS.seconds(5000.0) == 5.0


def test_a_gpu_holds_a_share_and_the_layers_at_work():
    held = Held(Size(100, 400, 10, 40, 20), learns=True, averaged=True)
    assert held.bytes(1) == 400 + 40 + 40 + 80  # the mean is of what learns, as large as its gradients
    assert held.bytes(4) == (400 + 40 + 40 + 80) / 4 + 2 * 20
    assert Held(Size(100, 400, 10, 40, 300)).bytes(4) == 400 / 4 + 400  # no more than there is


def test_memory_of_the_stages():
    plans = {stage.name: stage for stage in stage_plans(CONFIG, found(), GPUS)}
    # Two of eight rows on each of four GPUs.
    assert plans["sft"].activation_bytes == 2 * 4.0
    assert plans["sft"].whole_bytes == 400 + 40 + 80 + 2 * 4.0
    assert plans["sft"].sharded_bytes == (400 + 40 + 80) / 4 + 40 + 2 * 4.0
    # Two videos: the tokens of their frames, and two chunks painted, more than four judgements or two updates.
    held = 2 * 17 * 0.125 + max(2 * 5.0, 2 * 8 * 0.25, 4 * 1.0)
    assert plans["post_train"].activation_bytes == max(2 * 2.0, held, 2 * 4.0)
    assert plans["evaluate"].whole_bytes == 400 + 100 + max(1 * 2.0, 17 * 0.125 + max(8 * 0.25, 2 * 1.0))
    assert plans["post_train"].whole_bytes == (400 + 40 + 40 + 80) + 200 + 100 + held
    assert [name for name, stage in plans.items() if stage.physics] == [
        "demonstrate", "explore", "post_train", "evaluate",
    ]  # fmt: skip


def test_holding_keeps_the_policy_as_it_was_beside_the_one_that_learns():
    holding = dataclasses.replace(CONFIG, post_train=dataclasses.replace(CONFIG.post_train, hold=1.0))
    held, plain = ({stage.name: stage for stage in stage_plans(each, found(), GPUS)} for each in (holding, CONFIG))
    assert held["post_train"].whole_bytes - plain["post_train"].whole_bytes == 400
    assert held["sft"] == plain["sft"]


def test_bytes_that_a_gpu_sends():
    moved = moved_bytes(CONFIG, found(), GPUS)
    updates = 2 * 2  # sixteen decisions twice, eight at a time
    assert moved["whole"] == updates * 2 * 0.75 * 40
    lived = 2 * (400 + 200 + 10 + 90)  # two decisions, each part called once
    assert moved["sharded"] == 0.75 * (lived + updates * (2 * 400 + 40))
    alone = moved_bytes(CONFIG, found(), dataclasses.replace(GPUS, gpus=1))
    assert alone == {"whole": 0.0, "sharded": 0.0}


def test_a_stage_that_is_too_large_is_a_line_with_the_settings_that_help():
    plans = stage_plans(CONFIG, found(), GPUS)
    assert too_large(plans, GPUS) == []
    (line,) = too_large(plans, dataclasses.replace(GPUS, memory=350.0))
    assert line.startswith("post_train takes ") and "sharded over 4 GPUs, a GPU has" in line
    assert "less of --post-train.minibatch-size" in line and line.endswith("or more --gpus")


def test_every_stage_of_a_gpu_may_be_too_large():
    plans = stage_plans(dataclasses.replace(CONFIG, adapt=settings.Adapt(steps=10)), found(), GPUS)
    lines = too_large(plans, dataclasses.replace(GPUS, memory=0.0))
    assert [line.split()[0] for line in lines] == [stage.name for stage in plans[1:]]  # the expert needs none


@pytest.mark.parametrize("rounds", [1, 2])
def test_every_stage_of_the_run_is_planned(rounds):
    config = dataclasses.replace(CONFIG, rounds=rounds)
    names = [stage.name for stage in stage_plans(config, found(), GPUS)]
    assert names.count("evaluate") == 1 and len(names) == 3 + 4 * rounds

"""Recorded rollouts once more in the physics."""

from __future__ import annotations

import hashlib
import json

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import ExpertPolicy, TabletopEnv, chunked
from worldenv_trl.record import RolloutWriter, parse_edit, provenance, read_metadata, read_rollouts, recorded, replay

TASKS = ["starter/put_the_bowl_on_the_plate", "starter/open_the_top_drawer"]
BOWL, FILE = "starter/put_the_bowl_on_the_plate", "put_the_bowl.bddl"
BDDL = """
(define (problem LIBERO_Tabletop_Manipulation)
  (:domain robosuite)
  (:language put the bowl on the plate)
  (:regions
    (bowl_region (:target main_table) (:ranges ((-0.10 -0.05 -0.05 0.0))))
    (plate_region (:target main_table) (:ranges ((0.05 0.18 0.08 0.2)))))
  (:fixtures main_table - table)
  (:objects akita_black_bowl_1 - akita_black_bowl plate_1 - plate)
  (:obj_of_interest akita_black_bowl_1 plate_1)
  (:init (On akita_black_bowl_1 main_table_bowl_region) (On plate_1 main_table_plate_region))
  (:goal (And (On akita_black_bowl_1 plate_1))))
"""


def record(path, env, policy=None, *, described=True, exclude=()):
    torch.manual_seed(0)
    rows = env.batch_size[0]
    rollouts = next(iter(GroupCollector(env, policy, groups_per_batch=rows, group_size=1)))[:, 0]
    about = provenance(env) if described else {}
    with RolloutWriter(path, **about) as writer:
        writer.write(rollouts.exclude(*exclude))
    return rollouts


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """Four rollouts of the expert, two tasks in turn."""
    path = tmp_path_factory.mktemp("solved") / "a.mcap"
    env = TabletopEnv(TASKS, 4, image_size=32, seed=0, with_sim_state=True, proprio="commanded")
    record(path, env, ExpertPolicy(env))
    env.close()
    return path


def test_a_replay_is_bit_exact_and_is_written_beside_the_recording(solved):
    before = hashlib.sha256(solved.read_bytes()).digest()
    report = replay(solved, 3)
    assert report.exact is True and report.kind == "exact" and report.first is None
    assert set(report.compared) == {"sim_state", "kinematic_state", "state", "image", "success"}
    assert report.target == solved.with_name("a_rollout3_replay.mcap")
    recorded, played = read_rollouts(solved, rollouts=3)[0], read_rollouts(report.target)[0]
    recorded = recorded[recorded[keys.MASK]]
    assert torch.equal(played["next", keys.IMAGE], recorded["next", keys.IMAGE])
    assert torch.equal(played["next", "recorded", "image"], recorded["next", keys.IMAGE])
    assert hashlib.sha256(solved.read_bytes()).digest() == before
    with pytest.raises(FileExistsError, match="pass overwrite=True or another target"):
        replay(solved, 3)
    about = read_metadata(report.target)["replay"]
    assert (about["source"], about["rollout"], about["kind"]) == ("a.mcap", 3, "exact")
    assert "bit-exact" in str(report) and json.loads(json.dumps(report.to_json()))["exact"] is True


def test_the_wrist_s_images_are_replayed_and_compared_too(tmp_path):
    env = TabletopEnv(BOWL, 1, image_size=32, cameras=("agentview", "wrist"), seed=0, max_steps=3, with_sim_state=True)
    rollouts = record(tmp_path / "a.mcap", env)
    env.close()
    report = replay(tmp_path / "a.mcap")
    assert report.exact is True and {"image", "wrist_image"} <= set(report.compared)
    played = read_rollouts(report.target)[0]
    assert torch.equal(played["next", "recorded", "wrist_image"], rollouts["next", *keys.WRIST_IMAGE][0])
    changed = read_rollouts(tmp_path / "a.mcap")
    changed["next", *keys.WRIST_IMAGE] = changed["next", *keys.WRIST_IMAGE].clone()
    changed["next", *keys.WRIST_IMAGE][0, 1, 0, 5, 5] ^= 8
    with RolloutWriter(tmp_path / "b.mcap", **provenance_of(tmp_path / "a.mcap")) as writer:
        writer.write(changed)
    report = replay(tmp_path / "b.mcap", write=False)
    assert (report.first.step, report.first.field) == (2, "wrist_image") and report.psnr[2] < float("inf")


def test_chunks_of_actions_replay_exactly_and_so_does_a_replay(tmp_path):
    env = chunked(TabletopEnv(TASKS, 4, image_size=32, seed=1, max_steps=12, with_sim_state=True), 8)
    record(tmp_path / "a.mcap", env)
    env.close()
    report = replay(tmp_path / "a.mcap", 2)
    assert report.exact is True and report.steps == 12
    again = replay(report.target, 0)
    assert again.exact is True and again.source == report.target


def test_the_first_divergence_names_step_field_and_size(solved, tmp_path):
    rollouts = read_rollouts(solved, rollouts=0)
    rollouts["next", keys.STATE] = rollouts["next", keys.STATE].clone()
    rollouts["next", keys.STATE][0, 6, 2] += 0.25
    with RolloutWriter(tmp_path / "b.mcap", **provenance_of(solved)) as writer:
        writer.write(rollouts)
    report = replay(tmp_path / "b.mcap", 0, write=False)
    assert report.exact is False
    assert (report.first.step, report.first.field) == (7, "state")
    assert report.first.size == pytest.approx(0.25, abs=1e-6)
    assert len(report.divergences) == 1 and "DIVERGES first: step 7, state, by up to 0.25" in str(report)


def provenance_of(path):
    from worldenv_trl.record import read_attachments

    return {"metadata": read_metadata(path), "attachments": read_attachments(path)}


def test_without_a_recorded_state_it_starts_from_the_context(tmp_path):
    env = TabletopEnv(BOWL, 2, image_size=32, seed=0, max_steps=5)
    record(tmp_path / "a.mcap", env)
    env.close()
    report = replay(tmp_path / "a.mcap", 1)
    assert report.exact is True and "sim_state" not in report.compared
    assert any("initial state that the context_id" in note for note in report.notes)


def test_without_provenance_equality_is_not_claimed(tmp_path):
    env = TabletopEnv(BOWL, 1, image_size=32, seed=0, max_steps=4, with_sim_state=True)
    record(tmp_path / "a.mcap", env, described=False)
    env.close()
    report = replay(tmp_path / "a.mcap", write=False)
    assert report.exact is None and report.kind == "difference" and not report.divergences
    assert "equality is not claimed" in str(report) and any("does not describe its env" in n for n in report.notes)
    assert any("'put the bowl on the plate' is taken for starter/put_the_bowl" in note for note in report.notes)


def test_a_run_s_own_numbers_find_the_task_and_its_initial_state(tmp_path):
    env = TabletopEnv(TASKS, 2, image_size=32, seed=0, max_steps=3, task_ids=(7, 3))
    rollouts = record(tmp_path / "a.mcap", env)
    env.close()
    assert rollouts[keys.TASK_ID][:, 0, 0].tolist() == [7, 3]
    assert len(read_rollouts(tmp_path / "a.mcap", task=TASKS[1])) == 1
    for rollout in range(2):
        report = replay(tmp_path / "a.mcap", rollout, write=False)
        assert report.exact is True, str(report)


def test_a_task_whose_digest_has_changed_is_named(solved, tmp_path):
    about = provenance_of(solved)
    about["metadata"]["digests"] = ["0" * 16, about["metadata"]["digests"][1]]
    with RolloutWriter(tmp_path / "b.mcap", **about) as writer:
        writer.write(read_rollouts(solved))
    notes = [replay(tmp_path / "b.mcap", rollout, write=False).notes for rollout in (0, 1)]
    assert any(f"the task {TASKS[0]} is not the one that was recorded: its digest was" in note for note in notes[0])
    assert not notes[1]


def test_a_recording_without_digests_is_replayed(solved, tmp_path):
    about = provenance_of(solved)
    del about["metadata"]["digests"], about["metadata"]["instructions"]
    with RolloutWriter(tmp_path / "b.mcap", **about) as writer:
        writer.write(read_rollouts(solved))
    report = replay(tmp_path / "b.mcap", 1, write=False)
    assert report.exact is True and not report.notes


def test_nowhere_to_start_is_an_error(tmp_path):
    env = TabletopEnv(BOWL, 1, image_size=32, seed=0, max_steps=2)
    gone = (keys.CONTEXT_ID, ("next", keys.CONTEXT_ID))
    record(tmp_path / "a.mcap", env, exclude=gone)
    env.close()
    with pytest.raises(ValueError, match="the physics has nowhere to start"):
        replay(tmp_path / "a.mcap", write=False)


def test_a_replay_from_a_later_step_begins_at_its_recorded_state(solved):
    report = replay(solved, 1, from_step=9, write=False)
    assert report.exact is True and report.first_step == 9 and min(report.psnr) == 9


def test_an_edited_action_changes_what_follows_and_nothing_before(solved, tmp_path):
    report = replay(solved, 0, edits=parse_edit("6-9 dz=1 gripper=-1"), target=tmp_path / "edit.mcap")
    assert report.kind == "what-if" and report.exact is None
    assert report.branch["step"] == 6 and report.first.step == 7
    assert all(report.psnr[step] == float("inf") for step in range(7))
    played = read_rollouts(tmp_path / "edit.mcap")[0]
    assert (played[keys.ACTION][6:10, 2] == 1).all() and (played[keys.ACTION][6:10, 6] == -1).all()
    original = read_rollouts(solved, rollouts=0)[0][keys.ACTION]
    assert torch.equal(played[keys.ACTION][:6], original[:6])
    assert read_metadata(tmp_path / "edit.mcap")["replay"]["branch"]["edits"]["6"] == {"dz": 1.0, "gripper": -1.0}


def test_another_policy_acts_from_the_branch_on_until_the_step_limit(solved, tmp_path):
    policy = TensorDictModule(lambda state: torch.zeros(*state.shape[:-1], 4, 7), [keys.STATE], [keys.CHUNK])
    report = replay(solved, 0, from_step=5, policy=policy, target=tmp_path / "p.mcap")
    played = read_rollouts(tmp_path / "p.mcap")[0]
    assert report.first_step == 5 and report.steps == 72  # the task's own limit
    assert not played[keys.ACTION].any()
    assert report.outcome["recorded"]["success"] is True and report.outcome["replayed"]["success"] is False


def test_a_task_of_a_file_is_replayed_from_the_text_in_the_recording(tmp_path):
    source = tmp_path / FILE
    source.write_text(BDDL)
    env = TabletopEnv(str(source), 2, image_size=32, seed=0, max_steps=3, with_sim_state=True)
    record(tmp_path / "a.mcap", env)
    env.close()
    source.unlink()
    report = replay(tmp_path / "a.mcap", 1, write=False)
    assert report.exact is True and not report.notes


def test_another_scene_is_named(solved, tmp_path):
    about = provenance_of(solved)
    about["attachments"]["0.mjb"] = about["attachments"]["1.mjb"]
    with RolloutWriter(tmp_path / "b.mcap", **about) as writer:
        writer.write(read_rollouts(solved, rollouts=[0]))
    report = replay(tmp_path / "b.mcap", 0, write=False)
    assert any(f"the scene of {TASKS[0]} is not the one that was recorded" in note for note in report.notes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rollout": 9}, "holds the rollouts 0 to 3, not 9"),
        ({"from_step": 500}, "has steps 0 to"),
        ({"mode": "dream"}, "mode must be one of physics, imagination, got 'dream'"),
        ({"mode": "imagination"}, "pass its world_model"),
        ({"threshold": 0.5}, "pass a reflector, too"),
        ({"seed": 1}, "a seed changes nothing in the physics without a policy"),
        ({"edits": {300: {0: 0.0}}}, "the recorded actions end at step"),
        ({"edits": {3: {9: 0.0}}}, "has 7 dimensions"),
        ({"edits": {3: {0: 2.0}}}, r"actions lie in \[-1, 1\]"),
        ({"edits": {3: {0: 1.0}}, "from_step": 5}, "an edit names the step 3 before it"),
    ],
)
def test_what_cannot_be_replayed_is_said_before_anything_is_done(solved, options, message):
    files = sorted(solved.parent.iterdir())
    with pytest.raises(ValueError, match=message):
        replay(solved, **options)
    assert sorted(solved.parent.iterdir()) == files


def test_the_recording_itself_is_never_the_target(solved):
    with pytest.raises(ValueError, match="is the recording itself"):
        replay(solved, 0, target=solved, overwrite=True)


def test_rollouts_without_actions_are_refused(tmp_path):
    with RolloutWriter(tmp_path / "a.mcap") as writer:
        writer.write(TensorDict({"x": torch.zeros(1, 3, 2)}, [1, 3]))
    with pytest.raises(ValueError, match="holds no actions"):
        replay(tmp_path / "a.mcap")


@pytest.mark.parametrize("text", ["gripper=1", "3", "3 grip=1", "3 dx=4", "9-3 dx=0", "3 dx=--"])
def test_an_edit_that_cannot_be_read_is_an_error(text):
    with pytest.raises(ValueError, match=r"edit|dimensions"):
        parse_edit(text)


def test_edits_are_read_by_step_and_name():
    assert parse_edit("4 gripper=-1") == {4: {6: -1.0}}
    assert parse_edit(" 4-5 dx=0.5 rz=1e-1 ") == {4: {0: 0.5, 5: 0.1}, 5: {0: 0.5, 5: 0.1}}


def test_of_a_file_that_was_cut_off_the_steps_that_are_left_are_replayed(tmp_path):
    whole, cut = tmp_path / "a.mcap", tmp_path / "cut.mcap"
    env = TabletopEnv(BOWL, 1, image_size=64, seed=0, max_steps=64, with_sim_state=True)
    record(whole, env)
    env.close()
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) * 8 // 10])
    with pytest.warns(UserWarning, match="is truncated"):
        report = replay(cut, 0)
    assert report.exact is True and 0 < report.steps < 64
    assert report.target.exists() and cut.read_bytes() == data[: len(data) * 8 // 10]


def test_a_seed_repeats_a_what_if_and_leaves_other_random_numbers_alone(solved):
    def sample(state):
        return 0.2 * torch.randn(*state.shape[:-1], 4, 7)

    policy = TensorDictModule(sample, [keys.STATE], [keys.CHUNK])
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    runs = [replay(solved, 0, from_step=8, policy=policy, seed=seed, write=False) for seed in (1, 1, 2)]
    assert torch.equal(torch.rand(3), expected)
    assert runs[0].psnr == runs[1].psnr != runs[2].psnr


@pytest.mark.parametrize("name", ["spatial/pick_the_bowl_on_the_stove", "long/put_both_moka_pots_on_the_stove"])
def test_a_task_of_a_suite_is_found_in_its_recording(tmp_path, name):
    env = TabletopEnv([name, "starter/turn_on_the_stove"], 2, image_size=32, max_steps=6, seed=0)
    path = tmp_path / "suite.mcap"
    recording = recorded(env, path, **provenance(env))
    recording.rollout(6, ExpertPolicy(env))
    recording.close()
    for rollout in range(2):
        report = replay(path, rollout=rollout)
        assert report.exact, str(report)

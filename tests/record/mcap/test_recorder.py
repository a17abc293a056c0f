from __future__ import annotations

import contextlib
import errno
import multiprocessing
import time
import warnings

import pytest
import torch
from mcap.reader import make_reader
from recordings import NoiseEnv
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv
from torchrl.envs.transforms import TransformedEnv

from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import episodes_from_rollouts
from worldenv_trl.envs import ChunkedActions, TabletopEnv, chunked
from worldenv_trl.kinematics import ActionMap, ForwardKinematics
from worldenv_trl.record import Recorder, list_rollouts, model_hash, provenance, read_rollouts, recorded
from worldenv_trl.record.mcap.records import McapWriter
from worldenv_trl.record.mcap.scan import METADATA_COPY
from worldenv_trl.scenes import load_task

TASKS = ["starter/open_the_top_drawer", "starter/turn_on_the_stove"]
TEXTS = (keys.INSTRUCTION, ("next", keys.INSTRUCTION))


def make_env(rows: int = 4, **options) -> TabletopEnv:
    options = {"image_size": 32, "seed": 0, "max_steps": 6, "num_threads": 1} | options
    return TabletopEnv(TASKS[:rows], rows, **options)


def assert_recorded(read: TensorDict, rollouts: TensorDict, but: tuple = ()) -> None:
    mask = rollouts.get(keys.MASK, torch.ones(rollouts.shape, dtype=torch.bool))
    assert torch.equal(read[keys.MASK][:, : mask.shape[1]], mask)
    for key in rollouts.keys(True, True):
        if key not in (*TEXTS, *but):
            assert torch.equal(read[key][:, : mask.shape[1]][mask], rollouts[key][mask]), key
    assert read[:, 0].get(keys.INSTRUCTION).tolist() == rollouts[:, 0].get(keys.INSTRUCTION).tolist()


def test_what_a_rollout_shows_is_what_the_file_holds(tmp_path):
    env = recorded(make_env(with_sim_state=True), tmp_path / "a.mcap")
    waves = [env.rollout(9, break_when_any_done=False, break_when_all_done=True) for _ in range(2)]
    assert not (tmp_path / "a.mcap").exists()
    env.close()
    read = read_rollouts(tmp_path / "a.mcap")
    assert read.shape == (8, 6)
    assert_recorded(read[:4], waves[0])
    assert_recorded(read[4:], waves[1])
    assert read["row"][:, 0, 0].tolist() == [0, 1, 2, 3] * 2 and read["episode"][:, 0, 0].tolist() == [0] * 4 + [1] * 4
    causes = read["next", keys.TERMINATION].squeeze(-1)
    assert not causes[:, :-1].any() and (causes[:, -1] == keys.TERMINATIONS.index("step limit")).all()
    info = list_rollouts(tmp_path / "a.mcap")[6]
    assert (info.number, info.row, info.episode, info.length) == (6, 2, 1, 6)
    assert info.instruction == load_task(TASKS[0]).language


def test_chunks_are_recorded_as_decisions_with_their_last_one(tmp_path):
    env = recorded(chunked(make_env(max_steps=7), 4, frames=True), tmp_path / "a.mcap")
    torch.manual_seed(0)
    wave = next(iter(GroupCollector(env, None, groups_per_batch=4, group_size=1)))[:, 0]
    env.close()
    read = read_rollouts(tmp_path / "a.mcap")
    assert_recorded(read, wave, but=("returns",))
    assert episodes_from_rollouts(read)["length"].flatten().tolist() == [7] * 4
    flattened = TransformedEnv(TransformedEnv(make_env(), ChunkedActions(4)), Recorder(tmp_path / "b.mcap"))
    with pytest.raises(ValueError, match=r"record it with recorded\(env, path\)"):
        flattened.rollout(1)


def test_a_collector_that_resets_rows_starts_new_rollouts(tmp_path):
    env = recorded(make_env(rows=2, max_steps=3), tmp_path / "a.mcap")
    collector = Collector(env, None, frames_per_batch=8, total_frames=16)
    batches = torch.cat([batch.clone() for batch in collector], 1)  # [2, 8]
    collector.shutdown()
    read = read_rollouts(tmp_path / "a.mcap")
    assert read[keys.MASK].sum(-1).tolist() == [3, 3, 3, 3, 2, 2]
    for number in range(6):
        first, row = 3 * (number // 2), number % 2
        count = int(read[keys.MASK][number].sum())
        for key in (keys.IMAGE, keys.ACTION, ("next", *keys.STATE), ("next", "done")):
            assert torch.equal(read[key][number, :count], batches[key][row, first : first + count]), key


def test_predicted_states_action_maps_and_annotations_are_added(tmp_path):
    kinematics = ForwardKinematics()
    action_map = ActionMap(load_task(TASKS[0]).cameras[0], 32)
    path = tmp_path / "a.mcap"
    env = recorded(make_env(), path, kinematics=kinematics, action_map=action_map, exclude=[keys.NUM_STEPS])
    rollouts = env.rollout(6, break_when_any_done=False)
    recorder = env.transform
    assert recorder.rollouts == [0, 1, 2, 3]
    recorder.annotate(TensorDict({keys.ADVANTAGE: torch.arange(24.0).view(4, 6, 1)}, [4, 6]))
    env.close()
    read = read_rollouts(path)
    assert keys.NUM_STEPS not in read.keys()  # noqa: SIM118
    predicted = kinematics.state(kinematics(rollouts[keys.KINEMATIC_STATE], rollouts[keys.ACTION]))
    assert torch.allclose(read["next", keys.PREDICTED_STATE], predicted, atol=1e-6)
    assert (read["next", keys.PREDICTED_STATE][..., :3] - read["next", *keys.STATE][..., :3]).norm(dim=-1).max() < 0.05
    shown = read["next", keys.ACTION_MAP]
    assert shown.shape == (4, 6, 3, 32, 32) and (shown.flatten(2).amax(-1) > 150).all()
    assert torch.equal(read[keys.ADVANTAGE].flatten(), torch.arange(24.0))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"exclude": "sim_state"}, TypeError, "exclude must be a list of entries.*got 'sim_state'"),
        ({"exclude": [3]}, TypeError, r"exclude must be a list of entries.*got \[3\]"),
        ({"action_map": 1}, TypeError, "action_map must be a worldenv_trl.kinematics.ActionMap, got 1"),
        ({"kinematics": "fk"}, TypeError, "kinematics must be a worldenv_trl.kinematics.ForwardKinematics, got 'fk'"),
        ({"queue_size": 0}, ValueError, "queue_size must be a whole number of at least 1, got 0"),
        ({"queue_size": 2.5}, ValueError, "queue_size must be a whole number of at least 1, got 2.5"),
    ],
)
def test_options_of_another_kind_are_refused_at_once(tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        Recorder(tmp_path / "a.mcap", **options)


def test_a_black_first_image_does_not_blacken_the_later_ones(tmp_path):
    env = recorded(NoiseEnv(2, dark=True), tmp_path / "a.mcap")
    rollouts = torch.cat([env.rollout(4) for _ in range(2)])
    env.close()
    assert not rollouts[keys.IMAGE][:2, 0].any() and rollouts[keys.IMAGE][2:, 0].any()
    read = read_rollouts(tmp_path / "a.mcap")
    assert torch.equal(read[keys.IMAGE], rollouts[keys.IMAGE])
    assert torch.equal(read["next", *keys.IMAGE], rollouts["next", *keys.IMAGE])


def test_what_is_excluded_must_be_there_and_may_be_a_nest(tmp_path):
    env = recorded(make_env(), tmp_path / "a.mcap", exclude=["sucess"])
    with pytest.raises(ValueError, match=r"exclude names sucess, which the env does not show: did you mean success\?"):
        env.rollout(1)
    env.close()
    assert not list(tmp_path.iterdir())
    env = recorded(make_env(), tmp_path / "a.mcap", exclude=["observation", ("next", "reward")])
    env.rollout(2)
    env.close()
    have = read_rollouts(tmp_path / "a.mcap").keys(True, True)
    assert keys.ACTION in have and not {keys.IMAGE, keys.STATE, ("next", *keys.IMAGE), ("next", "reward")} & set(have)


def test_steps_reach_the_disk_within_a_second_while_the_env_pauses(tmp_path):
    env = recorded(make_env(), tmp_path / "a.mcap")
    env.rollout(3, break_when_any_done=False)
    deadline, steps = time.monotonic() + 5, 0
    while steps < 12:  # nobody calls the env or the recorder: its thread flushes
        assert time.monotonic() < deadline
        time.sleep(0.05)
        with warnings.catch_warnings(), contextlib.suppress(ValueError):
            warnings.simplefilter("ignore")
            steps = int(read_rollouts(tmp_path / "a.partial.mcap")[keys.MASK].sum())
    env.close()


def test_a_slow_disk_makes_the_env_wait_and_loses_nothing(tmp_path, monkeypatch):
    real = McapWriter.block

    def slow(self, *arguments):
        time.sleep(0.005)
        return real(self, *arguments)

    monkeypatch.setattr(McapWriter, "block", slow)
    env = recorded(make_env(max_steps=20), tmp_path / "a.mcap", queue_size=1)
    rollouts = env.rollout(20, break_when_any_done=False)
    env.close()
    assert_recorded(read_rollouts(tmp_path / "a.mcap"), rollouts)


def test_a_full_disk_is_raised_in_the_env_and_what_is_complete_stays(tmp_path, monkeypatch):
    env = recorded(make_env(), tmp_path / "a.mcap")
    env.rollout(3, break_when_any_done=False)
    env.transform.flush()

    def full(self, *_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(McapWriter, "block", full)
    # Steps are written once half a second has passed, in which a fast machine takes all of those below.
    monkeypatch.setattr("worldenv_trl.record.mcap.file.FLUSH_SECONDS", 0.0)
    with pytest.raises(OSError, match="the disk is full"):
        for _ in range(100):
            env.rollout(1, break_when_any_done=False)
    with pytest.raises(OSError, match="the disk is full"):
        env.close()
    with pytest.warns(UserWarning, match="truncated"):
        assert int(read_rollouts(tmp_path / "a.partial.mcap")[keys.MASK].sum()) == 12


def test_observations_that_change_behind_the_recorder_are_refused(tmp_path):
    env = recorded(make_env(), tmp_path / "a.mcap")
    td = env.rollout(1, break_when_any_done=False)[:, -1]["next"].clone()
    td[keys.STATE] += 1
    with pytest.raises(ValueError, match=r"'state'\) changed between two steps of row 0"):
        env.step(td.set(keys.ACTION, torch.zeros(4, 7)))
    env.close()


def _run_worker(path):
    env = recorded(make_env(rows=2), path)
    env.rollout(2, break_when_any_done=False)
    env.close()


def test_worker_processes_write_a_file_each(tmp_path):
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_run_worker, args=(tmp_path / "a.mcap",), name=f"worker-{i}") for i in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_worker-0.mcap", "a_worker-1.mcap"]
    assert read_rollouts(tmp_path).shape == (4, 2)


def test_two_recorders_on_one_path_are_refused(tmp_path):
    env = SerialEnv(2, lambda: recorded(make_env(rows=1), tmp_path / "a.mcap"))
    with pytest.raises(FileExistsError, match="another writer"):
        env.rollout(1)
    env.close()


def test_provenance_says_what_a_replay_needs(tmp_path):
    env = make_env(with_sim_state=True)
    model = torch.nn.Linear(3, 2)
    described = provenance(env, models={"policy": model}, config={"lr": (1, 2)}, stage="test")
    metadata = described["metadata"]
    assert metadata["tasks"] == TASKS and metadata["task_ids"] == [0, 1] and metadata["stage"] == "test"
    assert metadata["digests"] == [task.digest for task in env.tasks] and len(set(metadata["digests"])) == 2
    assert metadata["instructions"] == [task.language for task in env.tasks]
    assert metadata["env"]["seed"] == 0 and metadata["env"]["max_steps"] == 6 and metadata["config"] == {"lr": [1, 2]}
    assert metadata["models"]["policy"] == model_hash(model)
    camera = metadata["calibration"][TASKS[0]]["agentview"]
    assert camera["intrinsics"] == env.tasks[0].cameras[0].intrinsics(32).tolist() and camera["mount"] == "world"
    assert metadata["calibration"][TASKS[0]]["wrist"]["mount"] == "tool"
    recorder = recorded(env, tmp_path / "a.mcap", **described)
    recorder.rollout(1)
    recorder.close()
    with open(tmp_path / "a.mcap", "rb") as file:
        files = {each.name: each.data for each in make_reader(file).iter_attachments()}
    import mujoco

    assert files.pop(METADATA_COPY)
    assert set(files) == {f"{place}.{kind}" for place in (0, 1) for kind in ("mjb", "mjcf", "bddl")}
    (tmp_path / "scene.mjb").write_bytes(files["0.mjb"])
    compiled = mujoco.MjModel.from_binary_path(str(tmp_path / "scene.mjb"))
    assert compiled.nq == env.tasks[0].build().nq
    assert mujoco.MjModel.from_xml_string(files["1.mjcf"].decode()).nbody == env.tasks[1].build().nbody
    with torch.no_grad():
        model.weight[0, 0] += 1e-3
    assert metadata["models"]["policy"] != model_hash(model)

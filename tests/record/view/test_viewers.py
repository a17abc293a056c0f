"""What Rerun and Foxglove get to see of a recording."""

from __future__ import annotations

import os
import shutil
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from foxglove import layouts
from mcap.reader import make_reader
from PIL import Image

from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import ExpertPolicy, TabletopEnv, chunked
from worldenv_trl.record import RolloutWriter, parse_edit, provenance, read_rollouts, recorded, replay
from worldenv_trl.record.view.foxglove import foxglove_layout, foxglove_paths
from worldenv_trl.record.view.shown import shown_rollouts

TASK = "starter/open_the_top_drawer"


@pytest.fixture(scope="module")
def steps(tmp_path_factory) -> Path:
    """Two rollouts of the expert with both cameras, annotated."""
    path = tmp_path_factory.mktemp("steps") / "a.mcap"
    env = TabletopEnv(TASK, 2, image_size=32, cameras=("agentview", "wrist"), seed=0, with_sim_state=True)
    rollouts = next(iter(GroupCollector(env, ExpertPolicy(env), groups_per_batch=2, group_size=1)))[:, 0]
    with RolloutWriter(path, **provenance(env)) as writer:
        writer.write(rollouts)
        entries = rollouts.select(keys.MASK).set(keys.ADVANTAGE, torch.full((*rollouts.shape, 1), 0.25))
        writer.annotate(entries.exclude("collector"))
    env.close()
    return path


@pytest.fixture(scope="module")
def decisions(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("decisions") / "a.mcap"
    env = chunked(TabletopEnv(TASK, 2, image_size=32, seed=0, max_steps=12), 8, frames=True)
    torch.manual_seed(0)
    with RolloutWriter(path, **provenance(env)) as writer:
        writer.write(next(iter(GroupCollector(env, None, groups_per_batch=2, group_size=1)))[:, 0])
    env.close()
    return path


def test_what_is_shown_are_the_recorded_values_at_their_steps(steps):
    entries = read_rollouts(steps, rollouts=1)[0]
    entries = entries[entries[keys.MASK]]
    (shown,) = shown_rollouts(steps, [1])
    curves = {curve.name: curve for curve in shown.curves}
    assert torch.equal(curves["action"].values.float(), entries[keys.ACTION])
    assert curves["action"].labels == ("dx", "dy", "dz", "rx", "ry", "rz", "gripper")
    assert curves["action"].steps[0] == 0 and curves["reward"].steps[0] == 1
    assert torch.equal(curves["observation/state/rotation"].values.float(), entries["next", keys.STATE][:, 3:6])
    assert (curves["advantage"].values == 0.25).all()
    assert torch.equal(shown.images["image"][1][1:], entries["next", keys.IMAGE])
    assert set(shown.images) == {"image", "wrist_image", "action_map"}
    assert shown.images["action_map"][1].shape == shown.images["image"][1].shape
    assert shown.images["action_map"][1].float().mean((1, 2, 3)).min() > 0  # the hand is drawn in every frame
    assert shown.outcome == "success"
    assert shown.start > 0  # it plays after the rollout before it


def test_decisions_are_shown_step_by_step(decisions):
    (shown, _) = shown_rollouts(decisions)
    curves = {curve.name: curve for curve in shown.curves}
    assert curves["vla_action/chunk"].steps.tolist() == list(range(12))  # the last four of 16 were not executed
    assert curves["states/position"].steps.tolist() == list(range(1, 13))
    assert shown.images["image"][0].tolist() == list(range(13))


def test_every_camera_is_shown_with_what_was_recorded_of_it(steps, tmp_path):
    target = replay(steps, 0, target=tmp_path / "w.mcap", edits=parse_edit("3 dx=1")).target
    (shown,) = shown_rollouts(target)
    assert list(shown.images) == ["image", "recorded/image", "wrist_image", "recorded/wrist_image", "action_map"]
    entries = read_rollouts(steps, rollouts=0)[0]
    count = len(shown.images["recorded/wrist_image"][1])
    assert torch.equal(shown.images["recorded/wrist_image"][1][:9], entries["next", *keys.WRIST_IMAGE][:9])
    assert shown.images["recorded/wrist_image"][0].tolist() == list(range(1, count + 1))
    topics = {
        panel["imageMode"]["imageTopic"]
        for panel in foxglove_layout(target)["configById"].values()
        if "imageMode" in panel
    }
    assert topics == {f"/{kind}/{name}" for kind in ("observation", "recorded") for name in ("image", "wrist_image")}


def test_a_replay_is_shown_with_the_curves_of_what_was_recorded_and_says_of_what_it_is_one(steps, tmp_path):
    target = replay(steps, 1, target=tmp_path / "w.mcap", edits=parse_edit("3-20 gripper=-1")).target
    (shown,) = shown_rollouts(target)
    curves = {curve.name: curve for curve in shown.curves}
    before = read_rollouts(steps, rollouts=1)[0]
    before, played = before[before[keys.MASK]], read_rollouts(target)[0]
    first = curves["recorded/state/position"].steps[0] - 1
    opening = curves["recorded/state/position"].values[:, 3].float()
    assert torch.equal(opening, before["next", keys.STATE][first:, 6])
    assert not torch.equal(opening, played["next", keys.STATE][:, 6])
    assert curves["recorded/success"].values.flatten().tolist() == before["next", "success"][first:].flatten().tolist()
    assert shown.replayed == "a.mcap, rollout 1, in physics, changed from step 3 on"
    assert next(shown_rollouts(steps, [1])).replayed == ""
    layout = foxglove_layout(target)
    assert layout["configById"]["Image!camera"]["foxglovePanelTitle"] == f"replay of {shown.replayed}"
    assert foxglove_layout(steps)["configById"]["Image!camera"]["foxglovePanelTitle"] == "camera"


def values_in(layout: dict) -> list[str]:
    return [line["value"] for panel in layout["configById"].values() for line in panel.get("paths", [])]


def leaves_of(tree) -> list[str]:
    return [tree] if isinstance(tree, str) else leaves_of(tree["first"]) + leaves_of(tree["second"])


def test_every_panel_of_the_layout_that_ships_is_arranged_once():
    layout = foxglove_layout()
    assert sorted(leaves_of(layout["layout"])) == sorted(layout["configById"])


def test_foxglove_knows_every_setting_of_the_panels():
    kinds = {
        "Plot": layouts.PlotPanel,
        "Image": layouts.ImagePanel,
        "RosOut": layouts.LogPanel,
        "RawMessages": layouts.RawMessagesPanel,
        "3D": layouts.ThreeDeePanel,
    }
    for name, panel in foxglove_layout()["configById"].items():
        known = kinds[name.partition("!")[0]]().config._to_dict().keys() | {"foxglovePanelTitle"}
        assert panel.keys() <= known, name
        for line in panel.get("paths", []):
            assert line.keys() <= layouts.PlotSeries()._to_dict().keys()
        assert panel.get("imageMode", {}).keys() <= layouts.ImageModeConfig()._to_dict().keys()


@pytest.mark.parametrize("kind", ["steps", "decisions", "recorder", "replay"])
def test_the_layout_of_a_recording_names_only_topics_and_fields_that_are_in_it(kind, request, tmp_path):
    if kind == "recorder":
        path = tmp_path / "r.mcap"
        env = recorded(TabletopEnv(TASK, 2, image_size=32, seed=0, max_steps=3), path)
        env.rollout(3)
        env.close()
    elif kind == "replay":
        path = replay(
            request.getfixturevalue("steps"), 0, target=tmp_path / "w.mcap", edits=parse_edit("3 dx=1")
        ).target
    else:
        path = request.getfixturevalue(kind)
    with path.open("rb") as file:  # what another reader finds
        summary = make_reader(file).get_summary()
    topics = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    layout = foxglove_layout(path)
    panels = layout["configById"]
    assert sorted(leaves_of(layout["layout"])) == sorted(panels)
    for name, panel in panels.items():
        if name.startswith("Image!"):
            assert topics[panel["imageMode"]["imageTopic"]].name == "foxglove.RawImage"
    assert topics["/hand"].name == "foxglove.PoseInFrame" and topics["/instruction"].name == "foxglove.Log"
    for value in values_in(layout):
        topic, _, field = value.partition(".")
        assert field.partition("[")[0].encode() in topics[topic].data, value  # a field of the protobuf schema
    wanted = {
        "steps": ["/step.reward", "/step.action[6]", "/annotation_1.advantage", "/step.observation_state[0]"],
        "decisions": ["/step.reward", "/step.vla_action_chunk[0]"],
        "recorder": ["/step.reward", "/step.termination", "/step.action[0]"],
        "replay": ["/step.recorded_psnr", "/step.action[0]", "/step.recorded_state[0]", "/step.recorded_success"],
    }[kind]
    assert set(wanted) <= set(values_in(layout))
    assert ("Image!recorded" in panels) == (kind == "replay") and ("Image!wrist" in panels) == (
        kind in ("steps", "replay")
    )
    assert foxglove_paths(path)["/hand"] == {}


# ------------------------------------------------------------------------------------------------- Rerun


def saved(path: Path, target: Path, rollouts) -> Path:
    from worldenv_trl.record.view.rerun import rerun_recording

    recording = rerun_recording(path, rollouts)
    recording.save(target)
    recording.disconnect()
    return target


def columns(rrd: Path, index: str, entities: str) -> dict[str, list]:
    """What Rerun's own query engine reads from a recording, by column, in the order of ``index``."""
    pytest.importorskip("datafusion")
    from rerun.server import Server

    with Server(datasets={"shown": [str(rrd)]}) as server:
        data = server.client().get_dataset("shown").filter_contents([entities])
        found = data.reader(index=index).to_arrow_table()
    found = found.sort_by(index)
    return {name: found[name].to_pylist() for name in found.column_names if ":" in name}


def column(rrd: Path, index: str, entity: str, name: str) -> list:
    (values,) = (values for key, values in columns(rrd, index, entity).items() if key.endswith(name))
    return [value for value in values if value is not None]


def test_rerun_reads_back_the_scalars_images_and_poses(steps, tmp_path):
    pytest.importorskip("rerun")
    rrd = saved(steps, tmp_path / "a.rrd", [1])
    entries = read_rollouts(steps, rollouts=1)[0]
    entries = entries[entries[keys.MASK]]
    actions = column(rrd, "step", "/scalars/action", "Scalars:scalars")
    assert np.array_equal(np.array(actions, np.float32), entries[keys.ACTION].numpy())
    buffers = column(rrd, "step", "/camera/image", "Image:buffer")
    frames = np.stack([np.array(buffer[0], np.uint8).reshape(32, 32, 3) for buffer in buffers])
    assert np.array_equal(frames[1:], entries["next", keys.IMAGE].permute(0, 2, 3, 1).numpy())
    places = np.array(column(rrd, "step", "/world/hand", "Transform3D:translation"))[:, 0]
    assert np.allclose(places[1:], entries["next", keys.STATE][:, :3].numpy(), atol=1e-6)
    (said,) = column(rrd, "time", "/text", "TextLog:text")
    assert said[0].startswith("rollout 1: open the top drawer")


def test_rerun_opens_the_file_itself_with_images_poses_and_text(steps, tmp_path):
    rr = pytest.importorskip("rerun")
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "direct.rrd")
    recording.log_file_from_path(steps)
    recording.disconnect()
    names = list(columns(tmp_path / "direct.rrd", "message_log_time", "/**"))
    for name in ("Image:buffer", "InstancePoses3D:translations", "TextLog:text", "worldenv_trl.Step:message"):
        assert any(column.endswith(name) for column in names), name
    # Its numbers stay a structure that Rerun does not plot: hence rerun_recording.
    assert not any("Scalars" in column for column in names)


def test_the_rerun_viewer_draws_images_and_plots(steps, tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    from rerun.experimental import ViewerClient

    icd = Path("/usr/share/vulkan/icd.d")
    if not icd.is_dir():
        pytest.skip("no Vulkan driver: install mesa-vulkan-drivers")
    rrd = saved(steps, tmp_path / "a.rrd", [0])
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    import rerun_cli

    found = shutil.which("rerun") or str(Path(rerun_cli.__file__).with_name("rerun"))
    target = Path(os.environ.get("WORLDENV_ARTIFACTS", tmp_path)) / "rerun.png"
    with ViewerClient.spawn(headless=True, port=9931, executable_path=found) as viewer:
        viewer.open(str(rrd))
        for _ in range(20):
            time.sleep(1)
            viewer.save_screenshot(str(target))
            pixels = np.asarray(Image.open(target).convert("RGB")).astype(int)
            bright = (pixels.max(-1) > 120).mean((0,))  # by column: images on the left, lines on the right
            if bright[: len(bright) // 3].mean() > 0.05:
                break
    left, right = pixels[:, : pixels.shape[1] * 2 // 5], pixels[:, pixels.shape[1] * 2 // 5 :]
    assert (left.max(-1) > 120).mean() > 0.05
    colourful = (right.max(-1) - right.min(-1) > 80).sum()  # the curves: grids and text are grey
    assert colourful > 2000


def test_without_rerun_the_error_says_what_to_install(steps, monkeypatch):
    from worldenv_trl.record.view.rerun import rerun_recording

    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    with pytest.raises(ImportError, match=r"pip install 'worldenv_trl\[viz\]'"):
        rerun_recording(steps)


def test_the_layout_of_a_recording_that_was_cut_off_says_so(steps, tmp_path):
    path = tmp_path / "cut.mcap"
    path.write_bytes(steps.read_bytes()[:-200])
    with pytest.warns(UserWarning, match=f"{path} .*: Foxglove may show less of it"):
        layout = foxglove_layout(path)
    assert "/step.reward" in values_in(layout)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        foxglove_layout(steps)

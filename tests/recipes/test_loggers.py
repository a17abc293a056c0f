"""What the stages log arrives in TorchRL's loggers, and a logger in trouble costs nothing else."""

from __future__ import annotations

import dataclasses
import io
import os
import struct

import pytest
import torch
from mcap.reader import make_reader
from PIL import Image

import loggers as loggers_file
from checks import check_config
from config import PRESETS
from loggers import Loggers
from run_folder import RunFolder
from stages import open_run
from worldenv_trl.envs import TabletopEnv, chunked
from worldenv_trl.record import RolloutWriter, provenance

LINE = {"protocol": "physics", "policy": "sft", "task": "starter/open_the_top_drawer", "success": 0.25, "paired": True}
NAME = "evaluate/physics/sft/starter_open_the_top_drawer/success"


def opened(path, *kinds) -> RunFolder:
    folder = RunFolder(path / "run")
    config = dataclasses.replace(PRESETS["smoke"][1], run_dir=folder.path, logger=kinds)
    folder.open(config)
    folder.start_logging(config)
    return folder


def log_something(folder: RunFolder) -> None:
    for step in (0, 50):
        folder.log("sft", step=step, l1=1.0 / (step + 1))
    folder.log("evaluate", **LINE)
    folder.log("evaluate", **LINE | {"success": 0.5})  # no step: the second of its kind


def picture(folder: RunFolder):
    path = folder.plot("losses")
    Image.new("RGB", (24, 16), (200, 30, 10)).save(path)
    return path


@pytest.fixture
def recording(tmp_path):
    """Two rollouts of three steps, two cameras of 16 px; the frames of the first."""
    options = {"image_size": 16, "cameras": ("agentview", "wrist"), "seed": 0, "num_threads": 1}
    env = TabletopEnv("starter/open_the_top_drawer", 2, **options)
    rollouts = env.rollout(3)
    with RolloutWriter(tmp_path / "demo.mcap", **provenance(env)) as writer:
        writer.write(rollouts)
    env.close()
    first = rollouts[0]
    frames = torch.cat([first["observation", "image"][:1], first["next", "observation", "image"]])
    return tmp_path / "demo.mcap", frames


def scalars_of(path) -> dict[str, list[str]]:
    root = path / "csv" / "scalars"
    return {str(file.relative_to(root).with_suffix("")): file.read_text().split() for file in root.rglob("*.csv")}


def test_lines_become_named_curves_and_lines_without_a_step_are_counted(tmp_path):
    folder = opened(tmp_path, "csv")
    log_something(folder)
    folder.loggers.close()
    curves = scalars_of(folder.path / "logs" / "001")
    assert set(curves) == {"sft/l1", NAME}
    assert curves["sft/l1"] == ["0,1.0", f"50,{1 / 51}"] and curves[NAME] == ["0,0.25", "1,0.5"]
    assert len(folder.read_metrics()) == 4  # metrics.jsonl holds every line as it was
    assert folder.read_metrics("evaluate")[0] == {"stage": "evaluate"} | LINE
    (texts,) = (folder.path / "logs" / "001" / "csv" / "texts").iterdir()
    assert "post_train.iterations: 2" in texts.read_text().splitlines()


def test_a_name_with_dots_and_slashes_stays_in_the_folder(tmp_path):
    folder = opened(tmp_path, "csv")
    folder.log("explore", task="../../outside.bddl", success=1.0)
    folder.loggers.close()
    assert set(scalars_of(folder.path / "logs" / "001")) == {"explore/outside.bddl/success"}


def test_every_command_is_an_experiment_of_its_own_and_may_choose_its_loggers(tmp_path):
    for kinds in (("csv",), ("mcap", "csv"), (), ("mcap",)):
        folder = opened(tmp_path, *kinds)
        log_something(folder)
        folder.loggers.close()
    found = {str(path.relative_to(folder.path)) for path in (folder.path / "logs").glob("*/*")}
    assert found == {"logs/001/csv", "logs/002/csv", "logs/002/metrics.mcap", "logs/003/metrics.mcap"}


def test_an_mcap_log_is_whole_and_holds_scalars_pictures_videos_and_the_report(tmp_path, recording):
    path, frames = recording
    folder = opened(tmp_path, "mcap")
    log_something(folder)
    folder.loggers.images([picture(folder)])
    folder.loggers.recordings([path])
    page = folder.path / "report.html"
    page.write_text("<p>whole</p>")
    folder.loggers.page(page)
    folder.loggers.close()
    with open(folder.path / "logs" / "001" / "metrics.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        shown = {}
        for schema, channel, message in reader.iter_messages():
            shown.setdefault(channel.topic, []).append((schema, message.data))
        assert [attachment.data for attachment in reader.iter_attachments()] == [b"<p>whole</p>"]
    assert set(shown) == {"/sft/l1", f"/{NAME}", "/plots/losses", "/videos/demo_agentview", "/videos/demo_wrist"}
    assert {schema.name for schema, _ in shown[f"/{NAME}"]} == {"worldenv_trl.Scalar"}
    assert [struct.unpack_from("<d", data, 1)[0] for _, data in shown[f"/{NAME}"]] == [0.25, 0.5]
    assert len(shown["/videos/demo_agentview"]) == len(frames) == 4
    for (_, data), frame in zip(shown["/videos/demo_agentview"], frames, strict=True):
        assert frame.permute(1, 2, 0).contiguous().numpy().tobytes() in data
    assert bytes([200, 30, 10] * 24 * 16) in shown["/plots/losses"][0][1]


def test_tensorboard_shows_scalars_and_pictures(tmp_path, recording):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = opened(tmp_path, "tensorboard")
    log_something(folder)
    folder.loggers.images([picture(folder)])
    folder.loggers.recordings([recording[0]])
    assert set(folder.loggers.loggers) == {"tensorboard"}  # nothing of this has failed
    folder.loggers.close()
    events = EventAccumulator(str(folder.path / "logs" / "001" / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    assert [(each.step, each.value) for each in events.Scalars(NAME)] == [(0, 0.25), (1, 0.5)]
    assert sorted(events.Tags()["images"]) == ["plots/losses", "videos/demo_agentview", "videos/demo_wrist"]
    (shown,) = events.Images("videos/demo_agentview")
    film = Image.open(io.BytesIO(shown.encoded_image_string))
    assert film.format == "GIF" and film.size == (16, 16) and film.n_frames > 1
    assert "settings/text_summary" in events.Tags()["tensors"]


def test_mlflow_writes_to_the_run_folder(tmp_path, recording, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    folder = opened(tmp_path, "mlflow")
    log_something(folder)
    folder.loggers.images([picture(folder)])
    folder.loggers.recordings([recording[0]])
    (folder.path / "report.html").write_text("<p>whole</p>")
    folder.loggers.page(folder.path / "report.html")
    folder.loggers.close()
    client = mlflow.MlflowClient(f"sqlite:///{folder.path / 'logs' / 'mlflow.db'}")
    (run,) = client.search_runs([client.get_experiment_by_name("run").experiment_id])
    assert run.info.status == "FINISHED" and run.data.params["post_train.iterations"] == "2"
    assert [point.value for point in client.get_metric_history(run.info.run_id, NAME)] == [0.25, 0.5]
    kept = {path.name for path in (folder.path / "logs" / "mlflow").rglob("*") if path.is_file()}
    assert kept == {"losses.png", "demo_agentview.webm", "demo_wrist.webm", "report.html"}


def test_wandb_works_offline(tmp_path, recording, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    folder = opened(tmp_path, "wandb")
    log_something(folder)
    folder.loggers.images([picture(folder)])
    folder.loggers.recordings([recording[0]])
    assert set(folder.loggers.loggers) == {"wandb"}  # nothing of this has failed
    summary = dict(folder.loggers.loggers["wandb"].experiment.summary)
    folder.loggers.close()
    assert summary[NAME] == 0.5 and summary["sft/l1"] == pytest.approx(1 / 51)
    logs = folder.path / "logs" / "001" / "wandb"
    assert list(logs.glob("offline-run-*/*.wandb")) and list(logs.rglob("*.webm")) and list(logs.rglob("*.png"))


def test_logging_draws_no_random_number(tmp_path, recording):
    folder = opened(tmp_path, "csv", "mcap")
    before = torch.get_rng_state()
    log_something(folder)
    folder.loggers.recordings([recording[0]])
    folder.loggers.close()
    assert torch.equal(before, torch.get_rng_state())


def test_a_stage_shows_a_rollout_of_what_it_recorded_and_of_nothing_else(tmp_path, recording):
    folder = opened(tmp_path, "csv")
    target = folder.rollouts("before")
    target.write_bytes(recording[0].read_bytes())
    os.utime(target, (1, 1))
    with folder.stage("explore"):
        folder.rollouts("explore").write_bytes(recording[0].read_bytes())
    videos = {path.name for path in (folder.path / "logs" / "001" / "csv" / "videos").rglob("*.pt")}
    assert videos == {"explore_agentview_0.pt", "explore_wrist_0.pt"}
    saved = torch.load(next((folder.path / "logs").rglob("explore_agentview_0.pt")), weights_only=True)
    assert torch.equal(saved[0], recording[1])


def test_of_rollouts_recorded_by_decision_the_frames_at_decisions_are_shown(tmp_path):
    env = chunked(TabletopEnv("starter/open_the_top_drawer", 2, image_size=16, seed=0, num_threads=1), 4)
    rollouts = env.rollout(3)
    with RolloutWriter(tmp_path / "evaluate.mcap", **provenance(env)) as writer:
        writer.write(rollouts)
    env.close()
    folder = opened(tmp_path, "csv")
    folder.loggers.recordings([tmp_path / "evaluate.mcap"])
    (saved,) = (folder.path / "logs").rglob("*.pt")
    assert saved.name == "evaluate_agentview_0.pt"
    assert torch.equal(torch.load(saved, weights_only=True)[0], rollouts[0]["observation", "image"])


def test_a_logger_that_fails_is_left_out_with_one_line_and_the_others_go_on(tmp_path, capsys, monkeypatch):
    folder = opened(tmp_path, "csv", "mcap")

    def full(*_, **__):
        raise OSError("no space left on device")

    monkeypatch.setattr(folder.loggers.loggers["mcap"], "log_scalar", full)
    log_something(folder)
    folder.loggers.close()
    assert len(scalars_of(folder.path / "logs" / "001")) == 2 and len(folder.read_metrics()) == 4
    told = capsys.readouterr().err.splitlines()
    assert told == ["warning: the logger mcap failed and is left out: no space left on device"]


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        (("visdom",), "logger must be of csv, tensorboard, wandb, mlflow, mcap, got 'visdom'"),
        (("csv", "csv"), "logger names one twice: csv, csv"),
        (("csv", "wandb"), "the logger wandb needs a package that is not installed: pip install wandb$"),
    ],
)
def test_a_logger_that_cannot_be_is_refused_before_anything_is_made(kinds, message, tmp_path, monkeypatch):
    found = loggers_file.importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *a: None if name == "wandb" else found(name, *a))
    config = dataclasses.replace(PRESETS["smoke"][1], run_dir=tmp_path / "run", logger=kinds)
    with pytest.raises(ValueError, match=message):
        check_config(config)
    with pytest.raises(SystemExit, match=f"^error: .*{message}"):
        open_run(config)
    assert not config.run_dir.exists()


def test_a_logger_that_cannot_start_is_one_line_with_the_remedy(tmp_path, monkeypatch):
    def refuse(*_):
        raise RuntimeError("no API key\nconfigured")

    broken = dataclasses.replace(loggers_file.KINDS["wandb"], make=refuse, package=None)
    monkeypatch.setitem(loggers_file.KINDS, "wandb", broken)
    message = r"the logger wandb cannot start \(no API key configured\): leave it out; WANDB_MODE=offline logs"
    with pytest.raises(ValueError, match=message):
        Loggers.open(("csv", "wandb"), tmp_path, {})

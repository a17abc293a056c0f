"""Benchmarks refuse what cannot be measured in one line, before anything is measured."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from benchmark_module import benchmark

from worldenv_trl.scenes import list_tasks


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("scenes", {"tasks": ("gaol",)}, "'gaol' is no suite"),
        ("scenes", {"tasks": ("goal/open_the_top_drawr",)}, "did you mean 'goal/open_the_top_drawer'"),
        ("scenes", {"tasks": ("nowhere.bddl",)}, "there is no task file nowhere.bddl"),
        ("scenes", {"tasks": ()}, "--tasks is empty"),
        ("scenes", {"rows": (0, 16)}, "--rows must be at least 1, got 0"),
        ("scenes", {"rows": ()}, "--rows is empty"),
        ("scenes", {"threads": (0,)}, "--threads must be at least 1, got 0"),
        ("scenes", {"image_sizes": (8,)}, "--image-sizes must be at least 16, got 8"),
        ("scenes", {"repeats": 0}, "--repeats must be at least 1, got 0"),
        ("scenes", {"seconds": 0.0}, "--seconds must be positive, got 0.0"),
        ("expert", {"tasks": ("gaol",)}, "'gaol' is no suite"),
        ("expert", {"tasks": ("goal/open_the_top_drawr",)}, "did you mean 'goal/open_the_top_drawer'"),
        ("expert", {"tasks": ("nowhere.bddl",)}, "there is no task file nowhere.bddl"),
        ("expert", {"count": 0}, "--count must be at least 1, got 0"),
        ("expert", {"processes": 0}, "--processes must be at least 1, got 0"),
        ("resume", {"kills": -1}, "--kills must be at least 0, got -1"),
        ("resume", {"minutes": -1.0}, "--minutes must be at least 0, got -1.0"),
        ("resume", {"stages": ("dream",)}, "--stages must be among demonstrate, sft, explore, .*, got 'dream'"),
        ("throughput", {"device": "gpu"}, "device must be auto, cpu, cuda or cuda:N, got 'gpu'"),
        ("throughput", {"device": "cuda:99"}, "device 'cuda:99' does not exist"),
        ("scale_training", {"device": "gpu"}, "device must be auto, cpu, cuda or cuda:N, got 'gpu'"),
        ("scale_training", {"groups": 0}, "--groups must be at least 1, got 0"),
        ("scale_training", {"group_size": 1}, "--group-size must be at least 2, got 1"),
        ("throughput", {"group_size": 1}, "--group-size must be at least 2, got 1"),
        ("scale", {"collectors": ("process:40",)}, "40 workers are more than the groups of post_train.groups=24"),
        ("scale", {"collectors": ("local", "ray:0")}, "collectors must name at least 1 worker, got 'ray:0'"),
        ("scale", {"collectors": ()}, "--collectors is empty"),
        ("scale", {"repeats": 0}, "--repeats must be at least 1, got 0"),
        ("sft", {"device": "cuda:99"}, "device 'cuda:99' does not exist"),
        ("sft", {"suite": "gaol"}, "unknown suite 'gaol'"),
        ("sft", {"episodes_per_task": 0}, "--episodes-per-task must be at least 1, got 0"),
        ("sft", {"num_threads": 0}, "num_threads must be at least 1, got 0"),
        ("sft", {"seed": -1}, "seed must be at least 0, got -1"),
    ],
)
def test_what_cannot_be_measured_is_refused(name, settings, message, tmp_path):
    module = benchmark(name)
    if name == "sft":
        settings = {"run_dir": tmp_path / "run"} | settings
    kind = module.Settings if hasattr(module, "Settings") else module.Benchmark
    with pytest.raises(SystemExit, match=f"^error: .*{message}"):
        module.main(kind(**settings))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "name", ["beside", "damage", "expert", "group_signal", "kill", "record", "replay", "scenes", "sft", "throughput"]
)
def test_every_benchmark_takes_the_number_of_threads(name, tmp_path):
    module = benchmark(name)
    kind = module.Settings if hasattr(module, "Settings") else module.Benchmark
    needed = {"sft": {"run_dir": tmp_path / "run"}, "group_signal": {"run": tmp_path}, "beside": {"run": tmp_path}}.get(
        name, {}
    )
    with pytest.raises(SystemExit, match=r"num[_-]threads must be at least 1, got 0"):
        module.main(kind(num_threads=0, **needed))


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="memory is read from Linux's /proc")
def test_the_memory_of_a_stage_is_that_of_its_helpers_too(tmp_path):
    helper = "import time; x = bytearray(150_000_000); time.sleep(1.5)"
    starts = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {helper!r}])"
    costs = benchmark("stage_costs")
    seconds, _, resident, own = costs.measured([sys.executable, "-c", starts], tmp_path / "log")
    assert seconds > 1.5 and 150e6 < own < 400e6 and own <= resident
    with pytest.raises(SystemExit, match="ended with 3: see"):
        costs.measured([sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "log")


@pytest.mark.parametrize("arguments", [["smoke"], ["smoke", "--run-dir", "."]])
def test_costs_are_measured_in_a_new_folder_alone(arguments):
    with pytest.raises(SystemExit, match="new --run-dir"):
        benchmark("stage_costs").main(arguments)


@pytest.mark.parametrize(("states", "split", "first"), [("held-out", "test", 0), ("validation", "train", 1000)])
def test_sft_is_chosen_on_validation_states_and_reported_on_others(monkeypatch, tmp_path, capsys, states, split, first):
    module, counted, trained = benchmark("sft"), [], []

    def outcomes(run, actor, task, drawn_from, episodes, *, indices):
        counted.append((task, drawn_from, list(indices)))
        return torch.arange(episodes) == 0

    def fine_tune(run):
        trained.append(run.config.image_size)
        run.parts.policy.make(run.config).save_pretrained(run.folder.checkpoint("sft"))

    monkeypatch.setattr(module, "demonstrate", lambda _: None)
    monkeypatch.setattr(module, "fine_tune", fine_tune)
    monkeypatch.setattr(module, "physics_outcomes", outcomes)
    settings = module.Settings(tmp_path / "run", suite="starter", episodes_per_task=4, states=states, image_size=128)
    module.main(settings)
    module.main(settings)  # the policy is there: counted again, not trained again
    assert trained == [128] and counted[:3] == counted[3:]
    assert counted[:3] == [(task, split, [*range(first, first + 4)]) for task in list_tasks("starter")]
    assert f"starter, {states}, seed 0: 25.0% [8.9%, 53.2%]" in capsys.readouterr().out

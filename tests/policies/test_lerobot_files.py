"""What a LeRobot policy's folder says of normalisation, in both layouts."""

from __future__ import annotations

import json

import pytest
import torch
from lerobot_folders import REFERENCE, save_folder
from safetensors.torch import load_file, save_file

from worldenv_trl.policies.lerobot_files import Feature, read_lerobot_folder

KNOWN = ("smolvla", "pi0", "pi05")
STATE, ACTION = "observation.state", "action"
EDGES = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}


def with_mode(folder, mode: str):
    """The folder of a pi0 that normalises so, each feature by statistics of its own."""
    save_folder(folder, "pi0")
    config = json.loads((folder / "config.json").read_text())
    mapping = {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}
    (folder / "config.json").write_text(json.dumps(config | {"normalization_mapping": mapping}))
    generator = torch.Generator().manual_seed(0)
    tensors = {}
    for name, size in ((STATE, 8), (ACTION, 7)):
        for number, which in enumerate(EDGES.get(mode, ())):
            tensors[f"{name}.{which}"] = torch.rand(size, generator=generator) + number
    for which, step in (("pre", "normalizer_processor"), ("post", "unnormalizer_processor")):
        file = folder / f"policy_{which}processor.json"
        described = json.loads(file.read_text())
        described["steps"][1]["config"]["norm_map"] = mapping
        file.write_text(json.dumps(described))
        save_file(tensors, folder / f"policy_{which}processor_step_5_{step}.safetensors")
    return read_lerobot_folder(folder, KNOWN), tensors


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10", "IDENTITY"])
def test_each_way_of_normalising_maps_its_statistics_to_zero_and_one(tmp_path, mode):
    read, tensors = with_mode(tmp_path, mode)
    for name in (STATE, ACTION):
        affine = read.normalizer(name)

        def normal(x, affine=affine):
            return (x - affine.center) / affine.gain

        if mode == "IDENTITY":
            x = torch.randn(read.inputs[STATE].shape if name == STATE else (7,))
            assert torch.equal(normal(x), x)
            continue
        first, second = (tensors[f"{name}.{which}"] for which in EDGES[mode])
        if mode == "MEAN_STD":
            torch.testing.assert_close(normal(first), torch.zeros_like(first))
            torch.testing.assert_close(normal(first + 2 * second), torch.full_like(first, 2.0))
        else:
            torch.testing.assert_close(normal(first), -torch.ones_like(first))
            torch.testing.assert_close(normal(second), torch.ones_like(first))


def test_the_older_layout_says_what_the_newer_one_does(tmp_path):
    newer = read_lerobot_folder(save_folder(tmp_path / "newer", "pi05"), KNOWN)
    older = read_lerobot_folder(save_folder(tmp_path / "older", "pi05", buffers=True), KNOWN)
    assert newer.statistics.keys() == older.statistics.keys() == {STATE, ACTION}
    for name in (STATE, ACTION):
        for first, second in zip(*(vars(read.normalizer(name)).values() for read in (newer, older)), strict=True):
            assert torch.equal(first, second)
    names = dict(newer.shapes())
    assert names == dict(older.shapes()) == {name: tuple(t.shape) for name, t in older.tensors()}
    assert not any("normalize" in name for name in names)


def test_features_and_cameras_are_the_configs(tmp_path):
    read = read_lerobot_folder(save_folder(tmp_path, "smolvla"), KNOWN)
    assert read.kind == "smolvla" and read.outputs == {ACTION: Feature("ACTION", (7,))}
    assert read.image_features == ("observation.images.image", "observation.images.image2")  # one was always empty
    assert read.inputs[STATE] == Feature("STATE", (8,))


def test_what_the_processors_do_counts_where_the_config_says_otherwise(tmp_path):
    save_folder(tmp_path, "pi05")
    config = json.loads((tmp_path / "config.json").read_text())
    config["normalization_mapping"]["ACTION"] = "MIN_MAX"
    (tmp_path / "config.json").write_text(json.dumps(config))
    low = torch.tensor(REFERENCE["pi05"]["statistics"][ACTION]["q01"])
    affine = read_lerobot_folder(tmp_path, KNOWN).normalizer(ACTION)
    torch.testing.assert_close(affine.center - affine.gain, low)


def test_a_dimension_that_never_moves_is_divided_by_no_zero(tmp_path):
    for number, mode in enumerate(("MEAN_STD", "QUANTILES")):
        read, _ = with_mode(tmp_path / str(number), mode)
        first, second = EDGES[mode]
        read.statistics[ACTION][second][2] = 0.0 if mode == "MEAN_STD" else read.statistics[ACTION][first][2]
        affine = read.normalizer(ACTION)
        assert affine.gain[2] > 0 and ((read.statistics[ACTION][first] - affine.center) / affine.gain).isfinite().all()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.full((7,), torch.inf), r"std of action must be \[7\] finite numbers, got \[inf"),  # never set
        (torch.ones(6), r"std of action must be \[7\] finite numbers, got \[1.0"),
        (None, r"normalises action by MEAN_STD and holds no std of it \(there are: .*action.mean.*\): take the folder"),
    ],
)
def test_a_statistic_that_is_none_is_named(tmp_path, values, message):
    save_folder(tmp_path, "pi0", buffers=True)
    state = load_file(tmp_path / "model.safetensors")
    for name in [each for each in state if each.endswith("buffer_action.std")]:
        state.pop(name)
        if values is not None:
            state[name] = values.clone()
    save_file(state, tmp_path / "model.safetensors")
    read = read_lerobot_folder(tmp_path, KNOWN)
    read.normalizer(STATE)
    with pytest.raises(ValueError, match=message):
        read.normalizer(ACTION)


def test_a_way_of_normalising_that_is_not_known_is_named(tmp_path):
    save_folder(tmp_path, "pi0", buffers=True)
    config = json.loads((tmp_path / "config.json").read_text())
    config["normalization_mapping"]["STATE"] = "WHITEN"
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"must be of IDENTITY, MEAN_STD.*got 'WHITEN' for STATE"):
        read_lerobot_folder(tmp_path, KNOWN)


def test_half_the_range_is_taken_from_the_best_statistic_that_there_is(tmp_path):
    read = read_lerobot_folder(save_folder(tmp_path, "pi05"), KNOWN)
    known = {which: torch.tensor(values) for which, values in REFERENCE["pi05"]["statistics"][ACTION].items()}
    torch.testing.assert_close(read.half_range(ACTION), (known["q99"] - known["q01"]) / 2)
    for which in ("q01", "q99"):
        read.statistics[ACTION].pop(which)
    torch.testing.assert_close(read.half_range(ACTION), (known["max"] - known["min"]) / 2)
    for which in ("min", "max"):
        read.statistics[ACTION].pop(which)
    read.statistics[ACTION]["std"] = known["max"]
    torch.testing.assert_close(read.half_range(ACTION), 2 * known["max"])

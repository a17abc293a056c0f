import dataclasses
import json
from pathlib import Path

import pytest

from parts import COMPACT, Part
from stages import open_run


def left_by_another_run(tiny, name, text):
    folder = tiny.run_dir / "checkpoints" / name
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(text)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sft", "sft holds OtherPolicy, and the run's policy is OFTPolicy now: use another --run-dir"),
        ("post_train", "the run's policy is OFTPolicy"),
        ("world_model", "the run's world model is VideoWorldModel"),
        ("reflector", "the run's reflector is CompactReflector or DualReflector"),
    ],
)
def test_a_folder_of_other_parts_is_refused_and_left_as_it_was(tiny, name, message):
    left_by_another_run(tiny, name, json.dumps({"class": "OtherPolicy", "config": {}}))
    with pytest.raises(SystemExit, match=message):
        open_run(tiny)
    assert not (tiny.run_dir / "config.yaml").exists()


def test_a_folder_of_the_same_parts_goes_on(tiny):
    left_by_another_run(tiny, "sft", json.dumps({"class": "OFTPolicy"}))
    left_by_another_run(tiny, "reflector", json.dumps({"class": "DualReflector"}))
    left_by_another_run(tiny, "world_model", "not json")  # of a part that says nothing of itself
    open_run(tiny).close()


def test_a_checkpoint_that_no_stage_has_made_is_no_matter(tiny):
    left_by_another_run(tiny, "post_train_theirs", json.dumps({"class": "ExternalPolicy"}))
    open_run(tiny).close()


def test_what_a_loader_knows_is_not_guessed(tiny):
    left_by_another_run(tiny, "sft", json.dumps({"class": "OtherPolicy"}))

    def load(path: Path):
        raise AssertionError("nothing is loaded")

    swapped = Part(COMPACT.policy.make, load)
    assert swapped.known == () and COMPACT.world_model.known == ("VideoWorldModel",)
    open_run(tiny, dataclasses.replace(COMPACT, policy=swapped)).close()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"chunk_length": 4}, "OFTPolicy: chunk lengths differ, its is 4, the run's 8: --chunk-length 4"),
        ({"image_size": 32}, "OFTPolicy: its images are of 32 px, the run's of 64: --image-size 32"),
        (
            {"cameras": ("agentview", "wrist")},
            "it looks through agentview, wrist, .*: --cameras agentview wrist",
        ),
    ],
)
def test_a_part_that_is_made_for_another_run_is_refused_before_it_learns(tiny, changed, message):
    other = dataclasses.replace(tiny, **changed)
    parts = dataclasses.replace(COMPACT, policy=Part(lambda config: COMPACT.policy.make(other), COMPACT.policy.load))
    run = open_run(tiny, parts)
    with pytest.raises(ValueError, match=message):
        run.new("policy")
    run.close()

"""What the commands say about wrong arguments: one line that names the value and the remedy."""

from __future__ import annotations

import shutil

import pytest
import torch
import tyro
from foxglove import Channel, Context, open_mcap

import convert
import repair
import replay
import view
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import TabletopEnv
from worldenv_trl.policies import OFTConfig, OFTPolicy
from worldenv_trl.record import RolloutWriter, provenance
from worldenv_trl.record.mcap.file import McapFile
from worldenv_trl.record.mcap.scan import McapScan


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a recording of two rollouts of 8 steps, and files that are none."""
    folder = tmp_path_factory.mktemp("made")
    env = TabletopEnv("starter/open_the_top_drawer", 2, image_size=32, seed=0, max_steps=8, with_sim_state=True)
    torch.manual_seed(0)
    with RolloutWriter(folder / "real.mcap", **provenance(env)) as writer:
        writer.write(next(iter(GroupCollector(env, None, groups_per_batch=2, group_size=1)))[:, 0])
    env.close()
    context = Context()
    with open_mcap(folder / "foreign.mcap", context=context):
        Channel("/x", schema={"type": "object"}, context=context).log({"y": 1})
    (folder / "text.mcap").write_text("not a recording")
    (folder / "text.hdf5").write_text("not a recording")
    (folder / "notes.txt").write_text("not a recording")
    later = McapFile(folder / "later.mcap")
    later.write_metadata("worldenv_trl.rollouts", {"version": "99"})
    later.close()
    _without(folder / "real.mcap", folder / "imageless.mcap", "/observation/image")
    _without(folder / "real.mcap", folder / "stepless.mcap", "/step")
    data = bytearray((folder / "real.mcap").read_bytes())
    for chunk in McapScan(folder / "real.mcap").chunks:
        data[chunk.data.start + 50] ^= 0x40
    (folder / "ruined.mcap").write_bytes(data)
    (folder / "empty").mkdir()
    (folder / "empty.mcap").write_bytes(b"")
    (folder / "taken").mkdir()
    (folder / "taken.mcap").write_bytes(b"precious")
    (folder / "taken.rrd").write_bytes(b"precious")
    RolloutWriter(folder / "bare.mcap").close()
    OFTPolicy(OFTConfig(instructions=("do it",), dim=32, depth=1)).save_pretrained(folder / "policy")
    return folder


def _without(source, target, topic: str) -> None:
    """A copy that lacks a channel."""
    scan, file = McapScan(source), McapFile(target)
    messages = [message for chunk in scan.chunks for message in scan.messages(chunk)]
    for each in scan.metadata:
        file.write_metadata(each.name, each.metadata)
    for number, sequence, time, data in messages:
        channel = scan.channels[number]
        if channel.topic != topic:
            schema = scan.schemas[channel.schema_id]
            file.add(file.channel(channel.topic, schema.name, schema.data), time, bytes(data), sequence)
    file.close()


EVERYONE = [
    (("gone.mcap",), "gone.mcap"),
    (("text.mcap",), "text.mcap is not an MCAP file"),
    (("empty.mcap",), "empty.mcap is not an MCAP file: it has 0 bytes"),
    (("foreign.mcap",), "foreign.mcap holds no worldenv_trl rollouts: it was written by another program"),
    (("later.mcap",), "later.mcap has format version 99, this release reads up to 3: update worldenv_trl"),
]
READERS = [
    *EVERYONE,
    (("stepless.mcap",), "It was filtered or edited; read the original"),
    (("imageless.mcap",), "lacks images on /observation/image: it was filtered or edited; read the original"),
    (("ruined.mcap",), "ruined.mcap holds no rollouts"),
]
REPLAY = [
    *READERS,
    (("empty",), "empty is a folder: name one recording"),
    (("real.mcap", "--rollout", "2"), "holds the rollouts 0 to 1, not 2"),
    (("real.mcap", "--from-step", "8"), "has steps 0 to 7, not 8"),
    (("real.mcap", "--from-step", "-1"), "has steps 0 to 7, not -1"),
    (("real.mcap", "--edit", "open it"), "an edit reads like '43 gripper=-1'"),
    (("real.mcap", "--edit", "3 grip=-1"), "not 'grip'"),
    (("real.mcap", "--edit", "3 gripper=wide"), "an edit reads like '43 gripper=-1'"),
    (("real.mcap", "--edit", "3 gripper=-2"), "actions lie in [-1, 1], the edit of step 3 says -2"),
    (("real.mcap", "--edit", "6-4 dz=1"), "run backwards"),
    (("real.mcap", "--edit", "9 dz=1"), "end at step 7, an edit names 9"),
    (("real.mcap", "--edit", "2 dz=1", "--from-step", "3"), "the branch is at step 3, an edit names the step 2"),
    (("real.mcap", "--mode", "dreaming"), "mode must be one of physics, imagination, got 'dreaming'"),
    (("real.mcap", "--mode", "imagination"), "--world-model"),
    (("real.mcap", "--threshold", "0.5"), "--reflector"),
    (("real.mcap", "--threshold", "3"), "--threshold must be in (0, 1), got 3"),
    (("bare.mcap",), "bare.mcap holds no rollouts"),
    (("real.mcap", "--policy", "gone"), "gone is no folder and no policy of "),
    (("real.mcap", "--world-model", "policy", "--mode", "imagination"), "holds OFTPolicy, not VideoWorldModel"),
    (("real.mcap", "--seed", "1"), "pass --policy"),
    (("real.mcap", "--target", "real.mcap"), "is the recording itself"),
    (("real.mcap", "--target", "taken.mcap"), "taken.mcap exists: pass --overwrite"),
    (("real.mcap", "--target", "new.bag"), "must end in .mcap"),
    (("real.mcap", "--json", "taken.mcap"), "taken.mcap exists: pass --overwrite"),
    (("real.mcap", "--json", "empty", "--overwrite"), "--json must be a file, empty is a folder"),
]
VIEW = [
    *READERS,
    (("empty",), "empty is a folder: name one recording"),
    (("real.mcap", "--rollout", "2"), "holds the rollouts 0 to 1, not 2"),
    (("real.mcap", "--save", "taken.rrd"), "taken.rrd exists: pass --overwrite"),
    (("real.mcap", "--save", "new.mcap"), "--save must end in .rrd for rerun, got new.mcap"),
    (("real.mcap", "--viewer", "foxglove", "--save", "new.rrd"), "--save must end in .json for foxglove, got new.rrd"),
    (("real.mcap", "--viewer", "foxglove", "--save", "a.json", "--rollout", "2"), "holds the rollouts 0 to 1, not 2"),
    (("bare.mcap", "--viewer", "foxglove", "--save", "a.json", "--rollout", "0"), "bare.mcap holds no rollout 0"),
]
REPAIR = [
    *EVERYONE,
    (("real.mcap",), "real.mcap is whole: there is nothing to repair"),
    (("empty",), "empty is a folder"),
    (("ruined.mcap",), "ruined.mcap holds no complete step: it is damaged behind byte"),
]
CONVERT = [
    *(((*arguments, "new"), said) for arguments, said in READERS),
    (("gone", "new.mcap"), "there is no folder"),
    (("empty", "new.mcap"), "empty is no LeRobot dataset"),
    ((".", "new.mcap"), "is a folder of recordings: convert them one by one"),
    (("notes.txt", "new.mcap"), "notes.txt is neither a recording"),
    (("text.hdf5", "new.mcap"), "text.hdf5 is not a readable HDF5 file"),
    (("text.hdf5", "new"), "give a name that ends in .mcap instead of"),
    (("real.mcap", "new.mcap"), "a recording becomes a LeRobot folder"),
    (("real.mcap", "taken"), "taken exists: pass --overwrite"),
    (("real.mcap", "new", "--alignment", "executed"), "--alignment is for HDF5 files, real.mcap is none"),
    (("text.hdf5", "new.mcap", "--video"), "--video is for what becomes a LeRobot folder"),
]
CASES = [
    pytest.param(recipe, arguments, said, id=f"{recipe.__name__} {' '.join(arguments)}")
    for recipe, cases in ((replay, REPLAY), (view, VIEW), (repair, REPAIR), (convert, CONVERT))
    for arguments, said in cases
]


@pytest.mark.parametrize(("recipe", "arguments", "said"), CASES)
def test_wrong_arguments_give_one_line(recipe, arguments, said, made, tmp_path, monkeypatch, capsys):
    if recipe is view:
        pytest.importorskip("rerun")
        arguments = (*arguments, "--save", "new.rrd") if "--save" not in arguments else arguments
    if recipe is convert:
        pytest.importorskip("pyarrow")
        pytest.importorskip("h5py")
    folder = tmp_path / "made"
    shutil.copytree(made, folder)
    monkeypatch.chdir(folder)
    before = {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}
    assert recipe.main(tyro.cli(recipe.Options, args=arguments)) == 1
    told = capsys.readouterr()
    lines = [line for line in told.err.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1 and lines[0].startswith("error: ") and said in lines[0], told.err
    assert "=True" not in lines[0] and "Errno" not in lines[0]
    assert {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")} == before

"""Patterns: the same on every compilation, in every arena, and calmer than the things that lie on them."""

from __future__ import annotations

import subprocess
import sys
import zlib
from functools import cache

import mujoco
import numpy as np
import pytest
from dm_control import mjcf

from worldenv_trl.scenes import SceneBatch, load_task, materials
from worldenv_trl.scenes.materials import GRAIN, Material
from worldenv_trl.scenes.settings import SETTINGS

ALL = [value for value in vars(materials).values() if isinstance(value, Material)]
ONE_OF_EACH = {
    "tabletop": "goal/put_the_bowl_on_the_plate",
    "floor": "object/put_the_milk_in_the_basket",
    "kitchen": "long/turn_on_the_stove_and_put_the_moka_pot_on_it",
    "living_room": "long/put_the_soup_and_the_tomato_sauce_in_the_basket",
    "study": "long/put_the_book_in_the_caddy_and_the_mug_on_the_plate",
}
CHECKSUM = """
import zlib
from worldenv_trl.scenes import load_task
print(zlib.crc32(load_task({name!r}).build().tex_data.tobytes()))
"""


@cache
def without_each_thing(name: str) -> tuple[list[str], np.ndarray]:
    """Things of a task, and frames ``[3, 64, 64]`` of its first state: whole, without each of them, without any."""
    task = load_task(name)
    scene = SceneBatch(task, 1, num_threads=1)
    scene.reset(np.array([0]), task.init_states("train", 1))
    model, (pose,) = scene.model, scene.poses()
    bodies = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0 and model.body(b).name != "panda/"]
    bodies = [b for b in bodies if model.body_mocapid[b] >= 0 or model.body_dofnum[b] == 6]

    def removed(gone: list[int]):
        qpos, position, turn = (value.copy() for value in pose)
        for body in gone:
            if model.body_mocapid[body] >= 0:
                position[model.body_mocapid[body], 2] = -9.0
            else:
                qpos[model.jnt_qposadr[model.body_jntadr[body]] + 2] = -9.0
        return qpos, position, turn

    images = scene.drawing.render([removed(gone) for gone in ([], *([b] for b in bodies), bodies)])["agentview"]
    scene.close()
    return [model.body(b).name.strip("/") for b in bodies], images.astype(int)


@pytest.mark.parametrize("kind", ONE_OF_EACH)
def test_what_mujoco_generates_is_the_same_on_every_compilation(kind):
    name = ONE_OF_EACH[kind]
    once, again = load_task(name).build(), load_task(name).build()
    assert once.ntexdata > 0
    assert np.array_equal(once.tex_data, again.tex_data)


def test_what_mujoco_generates_is_the_same_in_another_process():
    name = ONE_OF_EACH["tabletop"]  # its grain is random
    other = subprocess.run(
        [sys.executable, "-c", CHECKSUM.format(name=name)], capture_output=True, text=True, check=True
    )
    assert int(other.stdout) == zlib.crc32(load_task(name).build().tex_data.tobytes())


@pytest.mark.parametrize("material", ALL, ids=lambda material: material.name)
def test_every_material_has_a_pattern_and_is_small(material):
    root = mjcf.RootElement()
    for _ in range(2):
        root.worldbody.add("geom", type="box", size=(1, 1, 1), **material.of(root))
    model = mujoco.MjModel.from_xml_string(root.to_xml_string())
    assert model.ntex == model.nmat == 1 and (model.geom_matid == 0).all()
    assert np.ptp(model.tex_data) > 0 and model.ntexdata <= 3 * 64 * 64


@pytest.mark.parametrize("kind", ONE_OF_EACH)
def test_the_arena_has_its_materials(kind):
    setting = SETTINGS[kind]
    model = load_task(ONE_OF_EACH[kind]).build()
    for geom, material in (("table", setting.table_material), ("wall", setting.wall_material)):
        assert model.material(int(model.geom(geom).matid[0])).name == material.name


def test_the_starter_scenes_have_a_grained_table():
    model = load_task("starter/open_the_top_drawer").build()
    assert model.material(int(model.geom("table").matid[0])).name == GRAIN.name


@pytest.mark.parametrize("kind", ONE_OF_EACH)
def test_everything_stands_out_from_what_is_behind_it(kind):
    names, images = without_each_thing(ONE_OF_EACH[kind])
    assert len(names) >= 3
    for name, without in zip(names, images[1:-1], strict=True):
        difference = np.abs(images[0] - without).max(0)
        own = difference > 10
        assert own.sum() >= 8, name
        assert difference[own].mean() > 25, name


@pytest.mark.parametrize("kind", ONE_OF_EACH)
def test_the_pattern_of_the_table_is_seen_and_calm(kind):
    table = without_each_thing(ONE_OF_EACH[kind])[1][-1][:, 40:]  # below the robot's foot
    spread = table.std((1, 2)).max()
    assert 0.5 < spread < 12
    assert max(np.abs(np.diff(table, axis=axis)).max() for axis in (1, 2)) < 30

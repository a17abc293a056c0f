"""Every category: it compiles, rests where it is put, and is as large as it says."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from worldenv_trl.scenes.arena import TabletopArena
from worldenv_trl.scenes.entities import CATEGORIES, make_entity
from worldenv_trl.scenes.entities.registry import WORKSPACES

FIXTURES = (
    "flat_stove",
    "stove", "cabinet", "wooden_cabinet", "white_cabinet", "microwave", "desk_caddy", "wine_rack",
    "wooden_two_layer_shelf",
)  # fmt: skip
MOVABLE = [name for name in CATEGORIES if name not in FIXTURES]


def compiled(category: str):
    arena, entity = TabletopArena(), make_entity(category, "thing")
    (arena.add_fixture if category in FIXTURES else arena.add_object)(entity)
    model = mujoco.MjModel.from_xml_string(arena.root.to_xml_string(), arena.root.get_assets())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return entity, model, data


def extent(model, data, body: int) -> np.ndarray:
    """Corners ``[k, 3]`` of the solid boxes and cylinders of a body and its children, from the body's origin."""
    corners = []
    for geom in range(model.ngeom):
        owner = model.geom_bodyid[geom]
        if model.body_rootid[owner] != body or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        size = model.geom_size[geom].copy()
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER:
            size = np.array([size[0] * 0.7071, size[0] * 0.7071, size[1]])
        signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
        corners.append(data.geom_xpos[geom] + (signs * size) @ data.geom_xmat[geom].reshape(3, 3).T)
    return np.concatenate(corners) - data.xpos[body]


@pytest.mark.parametrize("category", CATEGORIES)
def test_it_is_as_large_as_it_says_and_stands_on_its_origin(category):
    entity, model, data = compiled(category)
    corners = extent(model, data, model.body("thing/").id)
    assert corners[:, 2].min() == pytest.approx(0.0, abs=0.003)
    assert corners[:, 2].max() == pytest.approx(entity.height, abs=0.012)
    if category not in FIXTURES:  # handles of fixtures stand out
        assert np.hypot(*corners[:, :2].T).max() < entity.radius + 0.09
    for name, region in entity.regions.items():
        site = model.site(f"thing/{name}")
        assert np.allclose(site.size, region.half_size) and site.type == mujoco.mjtGeom.mjGEOM_BOX
        assert model.body(int(site.bodyid[0])).name.removeprefix("thing/") == region.body


@pytest.mark.parametrize("category", MOVABLE)
def test_it_stays_upright_where_it_is_put(category):
    _, model, data = compiled(category)
    body = model.body("thing/")
    start = model.jnt_qposadr[body.jntadr[0]]
    data.qpos[start : start + 3] = (0.05, 0.02, 0.002)
    mujoco.mj_step(model, data, 200)  # one second
    assert data.xmat[body.id].reshape(3, 3)[2, 2] > 0.999
    assert np.abs(data.xpos[body.id] - (0.05, 0.02, 0.0)).max() < 0.003
    assert np.abs(data.qvel[-6:]).max() < 0.02
    assert 0.05 < model.body_subtreemass[body.id] < 1.5


@pytest.mark.parametrize("category", FIXTURES)
def test_the_states_of_a_joint_exclude_each_other_and_can_be_reached(category):
    entity, model, _ = compiled(category)
    for (predicate, part), state in entity.states.items():
        low, high = model.jnt_range[model.joint(f"thing/{state.joint}").id]
        assert low - 1e-9 <= state.start[0] <= state.start[1] <= high + 1e-9
        assert part == "" or part in entity.regions
        opposite = {"Open": "Close", "Close": "Open", "TurnOn": "TurnOff", "TurnOff": "TurnOn"}[predicate]
        other = entity.states[opposite, part]
        assert state.high <= other.low or other.high <= state.low


def test_an_unknown_category_names_the_closest():
    with pytest.raises(ValueError, match="unknown category 'wooden_cabnet' of 'a_1': did you mean wooden_cabinet"):
        make_entity("wooden_cabnet", "a_1")
    assert not set(WORKSPACES) & set(CATEGORIES)

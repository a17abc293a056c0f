"""Imagination does without the simulator: its modules load neither the scenes nor what draws them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

# As on a machine that has neither: importing these fails, and whoever looks for them finds nothing.
WITHOUT = "import sys; sys.modules.update(dict.fromkeys(('mujoco', 'OpenGL', 'dm_control')))\n"
ALONE = "assert not [name for name in sys.modules if name.startswith('worldenv_trl.scenes')]"


def run(code: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    "imports",
    [
        "import worldenv_trl.kinematics",
        "import worldenv_trl.envs",
        "from worldenv_trl.envs import ImaginedEnv, context_id",
        "from worldenv_trl.envs import Reflect",
        "import worldenv_trl.world_models",
    ],
)
def test_imagination_needs_no_simulator(imports):
    run(f"{WITHOUT}{imports}\n{ALONE}")


def test_kinematics_work_where_there_is_no_simulator():
    run(f"""{WITHOUT}
import torch
from worldenv_trl.kinematics import ActionMap, ForwardKinematics
from worldenv_trl.robot import WRIST, panda
fk = ForwardKinematics()
state = fk.initial_state(torch.as_tensor(panda.HOME_Q, dtype=torch.float32))
pose = fk.pose(fk(state, torch.zeros(7)))
assert ActionMap(WRIST, 32)(pose, tool_pose=pose).any()
{ALONE}""")

"""The arm without a simulator: what its description says, and that it needs nothing but NumPy."""

import subprocess
import sys

from worldenv_trl.robot import panda


def test_urdf_names_every_joint_and_ends_at_the_tcp():
    text = panda.urdf()
    assert text.count('type="revolute"') == 7 and '<link name="tcp"/>' in text
    assert all(f'name="{joint.name}"' in text for joint in panda.JOINTS)


def test_the_description_needs_neither_torch_nor_mujoco_nor_gl():
    code = (
        "import sys, worldenv_trl.robot.panda\n"
        "assert not {'torch', 'mujoco', 'OpenGL', 'dm_control', 'worldenv_trl.scenes'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)

"""The Panda as a composer entity: the arm of :mod:`worldenv_trl.robot.panda`, drawn from primitives, with servos."""

from __future__ import annotations

from collections.abc import Sequence

from dm_control import composer, mjcf

from worldenv_trl.keys import CONTROL_HZ, POSE_DIM
from worldenv_trl.robot import WRIST, Camera
from worldenv_trl.robot.panda import FINGER_TRAVEL, HAND_OFFSET, HAND_YAW, JOINTS, TCP_FROM_HAND

TIMESTEP = 0.005
SUBSTEPS = round(1 / (CONTROL_HZ * TIMESTEP))  # of a control step
USERDATA = POSE_DIM  # of the model, for the controller's targets: x_des (3), R_des (9, row-major), opening

# Drawn size of each link: capsule from the joint's origin to this point in its frame, and its radius.
_LINKS = (
    ((0, 0, -0.20), (0, 0, 0), 0.06), ((0, 0, 0), (0, -0.20, 0), 0.06), ((0, 0, -0.10), (0, 0, 0), 0.055),
    ((0, 0, 0), (-0.0825, 0.10, 0), 0.055), ((0, 0, -0.25), (0, 0, 0), 0.05), ((0, 0, 0), (0.088, 0, 0), 0.045),
    ((0, 0, 0.02), (0, 0, 0.085), 0.04),
)  # fmt: skip
_SERVO_GAINS = (4500, 4500, 3500, 3500, 2000, 2000, 2000)
_TORQUE_LIMITS = (87, 87, 87, 87, 12, 12, 12)


class Panda(composer.Entity):
    """Arm and parallel gripper. Actuators: seven joint servos (target angle, rad), then one finger servo (width, m).

    Sites: ``tcp`` between the fingertips. Gravity is compensated on every link, so servos hold without offset.

    Args:
        name: of the model.
        cameras: those mounted on the tool.
    """

    def _build(self, name: str = "panda", cameras: Sequence[Camera] = (WRIST,)) -> None:
        self._root = mjcf.RootElement(model=name)
        self._root.compiler.angle = "radian"
        self._root.compiler.eulerseq = "XYZ"
        self._root.default.geom.set_attributes(contype=0, conaffinity=0, mass=0.0, rgba=(0.86, 0.87, 0.9, 1))
        body = self._root.worldbody.add("body", name="base", gravcomp=1)
        body.add("geom", type="capsule", fromto=(0, 0, 0.02, 0, 0, 0.13), size=(0.07,))
        for joint, (start, end, radius), torque in zip(JOINTS, _LINKS, _TORQUE_LIMITS, strict=True):
            # Only single-axis angles occur here, so URDF's roll, pitch, yaw and MuJoCo's Euler angles read the same.
            body = body.add(
                "body", name=joint.name.replace("joint", "link"), pos=joint.xyz, euler=joint.rpy, gravcomp=1
            )
            body.add("inertial", pos=joint.com, mass=joint.mass, fullinertia=joint.inertia)
            body.add(
                "joint", name=joint.name, type="hinge", axis=(0, 0, 1), range=(joint.lower, joint.upper), limited=True,
                damping=1.0, armature=0.1, actuatorfrclimited=True, actuatorfrcrange=(-torque, torque),
            )  # fmt: skip
            body.add("geom", type="capsule", fromto=(*start, *end), size=(radius,))
        hand = body.add("body", name="hand", pos=(0, 0, HAND_OFFSET), euler=(0, 0, HAND_YAW), gravcomp=1)
        hand.add("inertial", pos=(-0.01, 0, 0.03), mass=0.73, fullinertia=(0.001, 0.0025, 0.0017, 0, 0, 0))
        hand.add(
            "geom", name="palm", type="box", pos=(0, 0, 0.033), size=(0.022, 0.1, 0.033), rgba=(0.16, 0.17, 0.2, 1),
            contype=1, conaffinity=1,
        )  # fmt: skip
        for camera in cameras:  # the hand's axes are the tool's
            x, y, z = camera.position
            hand.add("camera", name=camera.name, pos=(x, y, z + TCP_FROM_HAND), xyaxes=camera.axes, fovy=camera.fovy)
        hand.add("site", name="tcp", pos=(0, 0, TCP_FROM_HAND), size=(0.004,), rgba=(0, 0, 0, 0))
        for side, sign in (("left", 1), ("right", -1)):
            finger = hand.add("body", name=f"{side}_finger", pos=(0, 0, 0.0584), gravcomp=1)
            finger.add("inertial", pos=(0, 0.015 * sign, 0.02), mass=0.015, diaginertia=(2.4e-6, 2.4e-6, 7.5e-7))
            finger.add(
                "joint", name=f"{side}_finger", type="slide", axis=(0, sign, 0), range=(0, FINGER_TRAVEL), limited=True,
                armature=0.1, damping=10.0,
            )  # fmt: skip
            finger.add(
                "geom", name=f"{side}_pad", type="box", pos=(0, 0.0085 * sign, 0.028), size=(0.0105, 0.0085, 0.024),
                rgba=(0.95, 0.45, 0.1, 1), contype=1, conaffinity=1, friction=(1.5, 0.05, 0.001), condim=4,
                solimp=(0.95, 0.99, 0.001), solref=(0.01, 1), priority=1,
            )  # fmt: skip
        self._root.equality.add(
            "joint", joint1="left_finger", joint2="right_finger", solref=(0.01, 1), solimp=(0.95, 0.99, 0.001)
        )
        for joint, gain in zip(JOINTS, _SERVO_GAINS, strict=True):
            self._root.actuator.add(
                "general", name=joint.name, joint=joint.name, biastype="affine", gainprm=(2 * gain,),
                biasprm=(0, -2 * gain, -0.02 * 2 * gain), ctrlrange=(joint.lower, joint.upper), ctrllimited=True,
            )  # fmt: skip
        self._root.actuator.add(
            "general", name="fingers", joint="left_finger", biastype="affine", gainprm=(2000,), biasprm=(0, -2000, -80),
            ctrlrange=(0, FINGER_TRAVEL), ctrllimited=True, forcerange=(-30, 30), forcelimited=True,
        )  # fmt: skip
        # Userdata carries the controller's targets, so that MuJoCo's integration state restores them too.
        self._root.size.nuserdata = USERDATA

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        return self._root

"""Boxes of regions against LIBERO's own verdicts.

Recorded from LIBERO (mujoco 3.2.3, robosuite 1.4.0): where a thing was from the region's centre (m, world axes), the
region's half size and yaw, and what LIBERO said. All 42 recorded ``In`` and 80 of 84 ``On`` agree; in the other four
the box holds, but the two things do not touch, which ``On`` asks for as well (see ``test_files.py``).
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from worldenv_trl.scenes.relations import inside, within

BASKET, CABINET, TABLE = (0.06108, 0.06108, 0.06949), (0.12534, 0.09438, 0.00147), (0.05, 0.05, 0.007)


def rotation(yaw: float) -> np.ndarray:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]])


@pytest.mark.parametrize(
    ("offset", "said"),
    [
        ((-0.0033, -0.0125, 0.0637), True),
        ((0.0463, -0.0140, 0.0389), True),
        ((0.0665, -0.0373, -0.0066), False),
        ((0.0665, 0.0361, -0.0415), False),
    ],
)
def test_in_a_basket_as_libero_says(offset, said):
    points, yaw = np.array([offset]), rotation(-math.pi / 2)
    assert inside(points, np.zeros((1, 3)), yaw, np.array(BASKET)).item() is said


@pytest.mark.parametrize(
    ("offset", "half", "yaw", "said"),
    [
        ((0.0001, -0.0030, 0.0004), CABINET, math.pi, True),
        ((-0.0181, -0.0151, -0.0001), CABINET, math.pi, True),
        ((0.0478, 0.0976, -0.0010), CABINET, math.pi, False),
        ((-0.1299, -0.0118, 0.0801), CABINET, math.pi, False),
        ((0.0462, 0.0407, 0.0398), TABLE, 0.0, True),
        ((-0.0420, 0.0506, 0.0398), TABLE, 0.0, False),
    ],
)
def test_on_a_region_as_libero_says(offset, half, yaw, said):
    assert within(np.array([offset]), np.zeros((1, 3)), rotation(yaw), np.array(half)).item() is said


def test_a_box_turns_with_what_it_belongs_to():
    center, half = np.array([[0.3, -0.2, 0.1]]), np.array((0.10, 0.02, 0.05))
    along = np.array([[math.cos(0.6), math.sin(0.6), 0.0]])
    across = np.array([[-math.sin(0.6), math.cos(0.6), 0.0]])
    for test, height in ((inside, 0.0), (within, 0.05)):
        up = np.array([[0.0, 0.0, height]])
        assert test(center + 0.09 * along + up, center, rotation(0.6), half).item()
        assert not test(center + 0.03 * across + up, center, rotation(0.6), half).item()
        assert not test(center + 0.09 * along + up, center, rotation(0.0), half).item()
    assert inside(center - (0, 0, 0.059), center, rotation(0.6), half).item()  # a centimetre below the floor
    assert not inside(center - (0, 0, 0.061), center, rotation(0.6), half).item()

from __future__ import annotations

from worldenv_trl.kinematics.calibrations import Calibrations, plain_cameras
from worldenv_trl.robot import look_at

FRONT = look_at("agentview", (0.8, 0.1, 0.6), (0.0, 0.0, 0.1), 40.0)
SIDE = look_at("agentview", (0.1, 0.9, 0.5), (0.0, 0.0, 0.0), 50.0)


def test_rows_are_told_by_what_they_are_seen_through_each_once():
    cameras = {"left": FRONT, "right": SIDE, "again": FRONT}
    views = Calibrations(plain_cameras({"agentview": cameras})["agentview"])
    texts = ["again", "right", "left", "right"]
    found = {camera.position: rows.tolist() for camera, rows in views.rows(texts)}
    assert found == {FRONT.position: [0, 2], SIDE.position: [1, 3]}
    assert [camera.position for camera, _ in views.rows(["left"])] == [FRONT.position]

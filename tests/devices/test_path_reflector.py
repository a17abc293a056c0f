"""A judge of paths on a GPU says what it says on the CPU, and learns there."""

from __future__ import annotations

import copy

import torch
from test_parts import near
from test_path import TEXTS, begun, further, make, paths, scenes, touching

from worldenv_trl.data import score_episodes
from worldenv_trl.objectives import ReflectorLoss
from worldenv_trl.reflectors import PathLessons


def test_the_reflector_judges_there_as_here(gpu):
    here, states = make(("front", "beside")), paths(3, 12)
    there, first = copy.deepcopy(here).to(gpu), scenes(3, ("front", "beside"))
    texts, scores = [TEXTS[0], TEXTS[1], TEXTS[0]], []
    for reflector, device in ((here, torch.device("cpu")), (there, gpu)):
        way = states.to(device)
        state = begun(reflector, {camera: frame.to(device) for camera, frame in first.items()}, way, texts)
        start = state["score"].unsqueeze(1)
        state, middle = further(reflector, state, way, 1, 6)
        scores.append(torch.cat([start, middle, further(reflector, state, way, 6, 13)[1]], 1))
    near(scores[1], scores[0])


def test_its_lessons_are_drawn_and_learned_there(gpu):
    reflector, names = make(lessons=PathLessons(epochs=1, place_epochs=1, batch_size=8)).to(gpu), []
    for lesson in reflector.train_on(touching(8, 0)):
        batch = lesson.sample()
        assert all(value.device.type == "cuda" for value in batch.values())
        ReflectorLoss(reflector)(batch)["loss_reflector"].backward()
        names.append(lesson.name)
    assert names == ["places", "paths"]
    assert all(each.grad is None or each.grad.device.type == "cuda" for each in reflector.parameters())
    assert score_episodes(reflector.eval(), touching(4, 1)).device.type == "cpu"

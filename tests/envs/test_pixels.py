"""Image specs: TorchRL's values without its arrays."""

import copy

import pytest
import torch
from torchrl.data import Composite, UnboundedContinuous, UnboundedDiscrete

from worldenv_trl.envs import TabletopEnv
from worldenv_trl.envs.pixels import Pixels

_SHAPE = (4, 2, 3, 16, 16)


def _numbers_held(spec: Pixels) -> int:
    return spec.space.low.untyped_storage().nbytes() + spec.space.high.untyped_storage().nbytes()


def _forms(spec: Pixels) -> dict[str, Pixels]:
    nested = Composite(entry=spec, shape=_SHAPE[:2])
    return {
        "clone": spec.clone(),
        "expand": spec.expand(5, *_SHAPE),
        "index": spec[1],
        "unsqueeze": spec.unsqueeze(0),
        "flatten": spec.flatten(0, 1),
        "unflatten": spec.unflatten(0, (2, 2)),
        "unbind": spec.unbind(0)[0],
        "stack": torch.stack([spec, spec.clone()], 0),
        "to": spec.to("cpu"),
        "deepcopy": copy.deepcopy(spec),
        "in a composite": nested.clone()["entry"],
        "in one that grows": nested.expand(3, *_SHAPE[:2])["entry"],
    }


@pytest.mark.parametrize("form", sorted(_forms(Pixels(_SHAPE))))
def test_every_form_is_what_torchrl_makes_of_it_and_holds_two_numbers(form):
    ours, theirs = _forms(Pixels(_SHAPE))[form], _forms(UnboundedDiscrete(_SHAPE, dtype=torch.uint8))[form]
    assert type(ours) is Pixels
    assert ours == theirs
    assert ours.shape == theirs.shape
    assert ours.zero().shape == theirs.zero().shape
    assert _numbers_held(ours) == 2


def test_it_takes_bytes_only():
    spec = Pixels(_SHAPE)
    assert spec.is_in(spec.rand())
    assert spec.rand().unique().numel() > 200
    assert not spec.is_in(torch.zeros(_SHAPE))
    assert isinstance(spec.to(torch.float32), UnboundedContinuous)
    with pytest.raises(ValueError, match=r"torch\.float32"):
        Pixels(_SHAPE, dtype=torch.float32)


def test_the_images_of_an_env_are_described_without_arrays():
    env = TabletopEnv("starter/open_the_top_drawer", 2, image_size=32, seed=0)
    try:
        assert _numbers_held(env.observation_spec["observation", "image"]) == 2
    finally:
        env.close()

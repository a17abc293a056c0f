import dataclasses
from math import inf, nan

import pytest

from config import PRESETS, WorldEnvConfig
from ranges import RANGES, Range, check_ranges

# Sizes of the compact parts, and what is checked together with other settings or by those whom it concerns.
ELSEWHERE = {
    "image_size",
    "sft.shift_px",
    "sft.dim",
    "sft.depth",
    "sft.vision_blocks",
    "world_model.width",
    "world_model.denoise_steps",
    "reflector.vision_blocks",
    "reflector.encoder_frames",
    "reflector.prefixes",
    "reflector.threshold",
    "reflector.consecutive",
    "real_size.frame_size",
}


def numbers(config, prefix=""):
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{prefix}{field.name}.")
        elif not isinstance(value, bool | str) and any(kind in str(field.type) for kind in ("int", "float")):
            yield prefix + field.name


def with_value(config, name, value):
    head, _, rest = name.partition(".")
    return dataclasses.replace(config, **{head: with_value(getattr(config, head), rest, value) if rest else value})


def test_every_number_among_the_settings_has_a_range_or_is_checked_elsewhere():
    assert set(numbers(WorldEnvConfig())) == set(RANGES) | ELSEWHERE and not ELSEWHERE & set(RANGES)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_presets_lie_inside(preset):
    check_ranges(PRESETS[preset][1])


@pytest.mark.parametrize("name", RANGES)
@pytest.mark.parametrize("number", [nan, -inf, -1])
def test_what_lies_in_no_range_is_named(name, number):
    with pytest.raises(ValueError, match=f"^{name} must .*, got "):
        check_ranges(with_value(WorldEnvConfig(), name, number))


@pytest.mark.parametrize(
    ("allowed", "inside", "outside", "text"),
    [
        (Range(1), (1, 2, inf), (0, nan), "be at least 1"),
        (Range(0, above=True), (1e-9, inf), (0, nan), "be above 0"),
        (Range(0, above=True, below=True), (1e-9, 1e9), (0, inf, nan), "be above 0 and finite"),
        (Range(0, 1), (0, 0.5, 1), (-1e-9, 1.001, nan), "lie between 0 and 1"),
        (Range(0, 1, below=True), (0, 0.999), (1, nan), "lie in [0, 1)"),
        (Range(0, 1, above=True, below=True), (0.5,), (0, 1), "lie in (0, 1)"),
    ],
)
def test_a_range_holds_what_it_says(allowed, inside, outside, text):
    assert all(number in allowed for number in inside) and not any(number in allowed for number in outside)
    assert str(allowed) == text


def test_each_of_several_numbers_must_lie_inside():
    with pytest.raises(ValueError, match=r"explore.scale_factors must be at least 0 and finite, got \(1.0, inf\)"):
        check_ranges(with_value(WorldEnvConfig(), "explore.scale_factors", (1.0, inf)))

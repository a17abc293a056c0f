"""Folders of LeRobot policies: what their config, their statistics and their weights say. The package is not needed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import torch
from torch import Tensor

from worldenv_trl.policies.hf_files import check_kind, check_weights, local_folder, read_json

__all__ = ["Affine", "Feature", "LeRobotFolder", "read_lerobot_folder"]

EPSILON = 1e-8  # LeRobot's, where a deviation or a range is zero
STATISTICS_OF = {
    "IDENTITY": (),
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""What each way of normalising needs to know of a feature."""

# Until LeRobot 0.4 the policy itself normalised: its statistics are buffers between its weights.
_BUFFERS = ("normalize_inputs.buffer_", "normalize_targets.buffer_", "unnormalize_outputs.buffer_")
_STEPS = {"policy_preprocessor.json": "normalizer_processor", "policy_postprocessor.json": "unnormalizer_processor"}


@dataclass(frozen=True)
class Feature:
    """An entry that a policy reads or writes: its ``kind``, ``STATE``, ``VISUAL``, ``ENV`` or ``ACTION``, and its
    ``shape`` without a batch."""

    kind: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Affine:
    """A normalisation: ``(x - center) / gain``, tensors of one feature's shape."""

    center: Tensor
    gain: Tensor


@dataclass(frozen=True)
class LeRobotFolder:
    """A LeRobot policy's folder, read but for its weights.

    Attributes:
        folder: where it is.
        kind: the policy's ``type``.
        fields: of ``config.json``.
        inputs, outputs: the features by name, in the config's order.
        normalization: by a feature's kind, one of :data:`STATISTICS_OF`.
        statistics: by feature and name (``mean``, ``q01`` ...), float32.
        weights: files that hold the network.
    """

    folder: Path
    kind: str
    fields: Mapping[str, Any]
    inputs: dict[str, Feature]
    outputs: dict[str, Feature]
    normalization: Mapping[str, str]
    statistics: Mapping[str, Mapping[str, Tensor]]
    weights: Sequence[Path]

    @property
    def image_features(self) -> tuple[str, ...]:
        """Names of its cameras; those that were only ever empty are left out."""
        seen = (name for name, feature in self.inputs.items() if feature.kind == "VISUAL")
        return tuple(name for name in seen if not name.rsplit(".", 1)[-1].startswith("empty_camera"))

    def normalizer(self, name: str) -> Affine:
        """How a feature is normalised.

        Raises:
            ValueError: if a statistic is missing, not finite, or of another shape than the feature.
        """
        feature = (self.inputs | self.outputs)[name]
        mode = self.normalization.get(feature.kind, "IDENTITY")
        first, second = (self._statistic(name, each, feature, mode) for each in STATISTICS_OF[mode] or (None, None))
        if mode == "IDENTITY":
            return Affine(torch.zeros(feature.shape), torch.ones(feature.shape))
        if mode == "MEAN_STD":
            return Affine(first, second + EPSILON)
        span = torch.where(second == first, EPSILON, second - first)
        return Affine(first + span / 2, span / 2)

    def half_range(self, name: str) -> Tensor:
        """Half the range that the training data used of a feature, as well as the statistics tell."""
        known, feature = self.statistics.get(name, {}), (self.inputs | self.outputs)[name]
        for low, high in (("q01", "q99"), ("min", "max")):
            if {low, high} <= set(known):
                return (known[high] - known[low]) / 2
        return 2 * known["std"] if "std" in known else torch.ones(feature.shape)

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """The network's weights by name, one file after the other; buffers of normalisation are left out.

        Raises:
            ValueError: if a file is truncated or corrupt.
        """
        for path in self.weights:
            for name, tensor in _tensors(path):
                if not name.startswith(_BUFFERS):
                    yield name.replace("_orig_mod.", ""), tensor

    def shapes(self) -> Iterator[tuple[str, tuple[int, ...]]]:
        """Shapes of :meth:`tensors`, without reading them."""
        for path in self.weights:
            for name, shape in _opened(path, lambda opened, name: tuple(opened.get_slice(name).get_shape())):
                if not name.startswith(_BUFFERS):
                    yield name.replace("_orig_mod.", ""), shape

    def _statistic(self, name: str, which: str | None, feature: Feature, mode: str) -> Tensor:
        if which is None:
            return torch.empty(0)
        value = self.statistics.get(name, {}).get(which)
        if value is None:
            known = ", ".join(f"{each}.{one}" for each, those in self.statistics.items() for one in those) or "none"
            raise ValueError(
                f"{self.folder} normalises {name} by {mode} and holds no {which} of it (there are: {known}): take the "
                "folder of a policy that was trained on such data, with its policy_*processor files, or fit the "
                "statistics to yours with fixed_statistics=False"
            )
        if tuple(value.shape) != feature.shape or not torch.isfinite(value).all():
            raise ValueError(
                f"{self.folder}: {which} of {name} must be {list(feature.shape)} finite numbers, got "
                f"{value.tolist()}: take the files that belong to this checkpoint"
            )
        return value


def read_lerobot_folder(folder: str | os.PathLike, known: Sequence[str]) -> LeRobotFolder:
    """Reads what a LeRobot policy's folder says of it; no weights, and no pickle, ever.

    Statistics are where LeRobot puts them since 0.4, in the safetensors of the (un)normalizer steps of
    ``policy_preprocessor.json`` and ``policy_postprocessor.json``, or where it did before, between the weights.

    Args:
        folder: with ``config.json`` and ``model.safetensors``, or ``owner/name`` of a repository of the Hub.
        known: types of policies that the caller can make.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: for another kind of checkpoint, a type that is not known, pickled weights, or a config that is
            not LeRobot's.
    """
    folder = local_folder(folder)
    fields = read_json(folder, "config.json")
    check_kind(fields, folder, "lerobot")
    if fields.get("type") not in known:
        raise ValueError(
            f"{folder} holds a LeRobot policy of type {fields.get('type')!r}, known are {', '.join(known)}: any other "
            "runs in LeRobot behind ExternalPolicy (worldenv_trl/policies/README.md)"
        )
    weights = check_weights(folder, "model*.safetensors")
    inputs, outputs = (_features(fields, name, folder) for name in ("input_features", "output_features"))
    statistics, normalization = _of_steps(folder)
    normalization = (fields.get("normalization_mapping") or {}) | normalization
    for kind, mode in normalization.items():
        if mode not in STATISTICS_OF:
            raise ValueError(
                f"{folder / 'config.json'}: normalization_mapping must be of {', '.join(STATISTICS_OF)}, got "
                f"{mode!r} for {kind}"
            )
    statistics = statistics or _of_buffers(weights, (*inputs, *outputs))
    return LeRobotFolder(folder, fields["type"], fields, inputs, outputs, normalization, statistics, weights)


def _features(fields: Mapping[str, Any], which: str, folder: Path) -> dict[str, Feature]:
    try:
        return {name: Feature(str(one["type"]), tuple(one["shape"])) for name, one in fields[which].items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{folder / 'config.json'}: {which} must hold a type and a shape for each name, got {fields.get(which)!r}"
        ) from error


def _of_steps(folder: Path) -> tuple[dict[str, dict[str, Tensor]], dict[str, str]]:
    """Statistics, and how they are used: what these files say of that is what LeRobot does."""
    found: dict[str, dict[str, Tensor]] = {}
    modes: dict[str, str] = {}
    for file, step in _STEPS.items():
        if not (folder / file).is_file():
            continue
        for described in read_json(folder, file).get("steps", []):
            if described.get("registry_name") != step or not described.get("state_file"):
                continue
            modes |= described.get("config", {}).get("norm_map", {})
            path = folder / described["state_file"]
            if not path.is_file():
                raise FileNotFoundError(f"{path} is missing, whose statistics {file} names: fetch it again")
            for name, tensor in _tensors(path):
                feature, _, which = name.rpartition(".")
                found.setdefault(feature, {})[which] = tensor.float()
    return found, modes


def _of_buffers(weights: Sequence[Path], features: Sequence[str]) -> dict[str, dict[str, Tensor]]:
    found: dict[str, dict[str, Tensor]] = {}
    names = {name.replace(".", "_"): name for name in features}  # as names of buffers were made
    for path in weights:
        for name, tensor in _tensors(path, _BUFFERS):
            prefix = next(each for each in _BUFFERS if name.startswith(each))
            feature, _, which = name[len(prefix) :].rpartition(".")
            found.setdefault(names.get(feature, feature), {})[which] = tensor.float()
    return found


def _tensors(path: Path, prefixes: tuple[str, ...] = ("",)) -> Iterator[tuple[str, Tensor]]:
    return _opened(path, lambda opened, name: opened.get_tensor(name), prefixes)


def _opened(path: Path, get: Callable[[Any, str], Any], prefixes: tuple[str, ...] = ("",)) -> Iterator[tuple[str, Any]]:
    try:
        with safetensors.safe_open(path, framework="pt") as opened:
            for name in opened.keys():  # noqa: SIM118 (it is no mapping)
                if name.startswith(prefixes):
                    yield name, get(opened, name)
    except safetensors.SafetensorError as error:
        raise ValueError(f"{path} is truncated or corrupt ({error}): fetch it again") from error

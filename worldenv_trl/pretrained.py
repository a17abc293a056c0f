"""Saving and loading of learned parts: a plain config file beside a safetensors file, in a folder or on the Hub."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import safetensors
import safetensors.torch
import torch

from worldenv_trl import hub

CONFIG_NAME = "config.json"
WEIGHTS_NAME = "model.safetensors"


if TYPE_CHECKING:
    from torch.nn import Module as _Module  # it stands beside one
else:
    _Module = object


def with_tuples(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a JSON object as a config has them: lists are tuples; what lies deeper stays as it is."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}


class OtherClassError(ValueError):
    """A checkpoint holds a part of another class."""


class Pretrained(_Module):
    """Gives an ``nn.Module`` ``save_pretrained(folder)``, ``from_pretrained(folder or id)`` and ``push_to_hub(id)``.

    The module is built from one dataclass: ``__init__(self, config)`` accepts an instance of :attr:`config_class`
    alone and keeps it as ``self.config``. Parameters and persistent buffers are saved. A config is written with
    ``dataclasses.asdict`` (arrays as nested lists) and rebuilt as ``config_class(**fields)`` with lists turned into
    tuples; a config with nested objects or non-string dictionary keys defines the classmethod ``from_dict(fields)``. A
    module that needs further files, a tokenizer's, names them in :attr:`companion_names`, writes them in
    :meth:`companions` and reads them in :meth:`build`.

    Examples:
        >>> import dataclasses, tempfile, torch
        >>> @dataclasses.dataclass(frozen=True)
        ... class ScaleConfig:
        ...     dim: int = 3
        >>> class Scale(torch.nn.Module, Pretrained):
        ...     config_class = ScaleConfig
        ...     def __init__(self, config):
        ...         super().__init__()
        ...         self.config = config
        ...         self.weight = torch.nn.Parameter(torch.ones(config.dim))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Scale(ScaleConfig(dim=4)).save_pretrained(folder)
        ...     Scale.from_pretrained(folder).config
        ScaleConfig(dim=4)
    """

    config_class: ClassVar[type]
    companion_names: ClassVar[tuple[str, ...]] = ()
    config: Any

    def companions(self) -> dict[str, bytes]:
        """Contents of the files named in :attr:`companion_names`."""
        return {}

    @classmethod
    def build(cls, config: Any, folder: Path) -> Self:
        """The module of a config that was read from ``folder``, before its weights are."""
        return cls(config)

    def save_pretrained(self, folder: str | os.PathLike) -> Path:
        """Writes ``config.json``, ``model.safetensors`` and companions into ``folder`` and returns it.

        The folder is made if it is missing. All files are complete on disk before any replaces one of the same name.
        """
        folder = Path(folder)
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"cannot save {type(self).__name__} to {folder}: it is a file, name a folder")
        folder.mkdir(parents=True, exist_ok=True)
        # clone(): safetensors refuses views that share memory, and views would save their whole base.
        state = {name: t.detach().cpu().contiguous().clone() for name, t in self.state_dict().items()}
        weights = safetensors.torch.save(state, metadata={"class": type(self).__name__})
        config = {
            "class": type(self).__name__,
            "weights_sha256": hashlib.sha256(weights).hexdigest(),
            "config": _to_json(dataclasses.asdict(self.config)),
        }
        contents = self.companions() | {
            WEIGHTS_NAME: weights,
            CONFIG_NAME: (json.dumps(config, indent=2) + "\n").encode(),
        }
        temporary = {name: folder / f".{name}.{os.getpid()}.tmp" for name in contents}
        try:
            for name, data in contents.items():
                with open(temporary[name], "wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
            for name in contents:
                os.replace(temporary[name], folder / name)
        finally:
            for path in temporary.values():
                path.unlink(missing_ok=True)
        return folder

    def push_to_hub(
        self,
        repo_id: str,
        *,
        private: bool | None = None,
        revision: str | None = None,
        commit_message: str | None = None,
    ) -> str:
        """Uploads what :meth:`save_pretrained` writes to the Hugging Face Hub; returns the address of the commit.

        Args:
            repo_id: ``owner/name``; made if it does not exist.

        Keyword Args:
            private: of a new repository; the owner's default when None.
            revision: branch, made if it does not exist; ``main`` when None.
            commit_message: names the class when None.

        Raises:
            ValueError: if ``repo_id`` is not ``owner/name``.
            OSError: if the Hub refuses or cannot be reached.
        """
        message = f"Upload a {type(self).__name__} of worldenv_trl" if commit_message is None else commit_message
        with tempfile.TemporaryDirectory() as folder:
            self.save_pretrained(folder)
            return hub.upload(folder, repo_id, private=private, revision=revision, message=message)

    @classmethod
    def from_pretrained(
        cls, name: str | os.PathLike, *, device: str | torch.device = "cpu", revision: str | None = None
    ) -> Self:
        """Rebuilds the module that :meth:`save_pretrained` wrote to a folder, or :meth:`push_to_hub` to the Hub.

        Args:
            name: a folder, or ``owner/name`` of a repository. What exists on this machine always wins, and the Hub is
                asked for nothing but text that can be no path: see :func:`~worldenv_trl.hub.is_repo_id`.

        Keyword Args:
            device: of the parameters.
            revision: branch, tag or commit of a repository; ``main`` when None.

        Raises:
            FileNotFoundError: if the folder, one of its files or the repository is missing.
            ValueError: if the checkpoint is truncated, corrupt, or of another class or shape.
        """
        remote = hub.is_repo_id(name)
        files = [CONFIG_NAME, WEIGHTS_NAME, *cls.companion_names]
        folder = hub.download(str(name), files, revision=revision) if remote else Path(name)
        if (folder / CONFIG_NAME).is_file():  # of another class, which may lack companions
            _read_config(folder / CONFIG_NAME, cls.__name__)
        for path in (folder, *(folder / file for file in files)):
            if not path.exists():
                writes = "repository that push_to_hub" if remote else f"folder that {cls.__name__}.save_pretrained"
                raise FileNotFoundError(
                    f"no {cls.__name__} checkpoint at {name}: {path.name if remote else path} is missing. "
                    f"Name a {writes} wrote."
                )
        fields, digest = _read_config(folder / CONFIG_NAME, cls.__name__)
        try:
            from_dict = getattr(cls.config_class, "from_dict", None)
            config = from_dict(fields) if from_dict else cls.config_class(**_to_tuples(fields))
            module = cls.build(config, folder)
        except (TypeError, ValueError, KeyError) as error:
            raise ValueError(f"{folder / CONFIG_NAME} does not describe a {cls.__name__}: {error}") from error
        weights = (folder / WEIGHTS_NAME).read_bytes()
        if digest is not None and hashlib.sha256(weights).hexdigest() != digest:
            raise ValueError(
                f"{folder / WEIGHTS_NAME} is truncated, corrupt or not the file that was saved with "
                f"{CONFIG_NAME} ({len(weights)} bytes). Restore it from a copy or train this part again."
            )
        try:
            module.load_state_dict(safetensors.torch.load(weights))
        except (safetensors.SafetensorError, RuntimeError) as error:
            raise ValueError(
                f"{folder / WEIGHTS_NAME} does not hold the weights of its config; if another version of worldenv_trl "
                f"saved it, train this part again: {error}"
            ) from error
        return module.to(device)


def saved_class(folder: str | os.PathLike) -> str | None:
    """Name of the class whose ``save_pretrained`` wrote a checkpoint; None for a folder that does not say."""
    try:
        found = json.loads((Path(folder) / CONFIG_NAME).read_text())["class"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found if isinstance(found, str) else None


def _read_config(path: Path, class_name: str) -> tuple[dict, str | None]:
    try:
        config = json.loads(path.read_text())
        saved_class, fields = config["class"], config["config"]
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is not a complete checkpoint config ({error!r}): restore it or train again"
        ) from error
    if saved_class != class_name:
        raise OtherClassError(f"{path.parent} holds {saved_class}, not {class_name}: use {saved_class}.from_pretrained")
    return fields, config.get("weights_sha256")


def _to_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(item) for item in value]
    if isinstance(value, np.ndarray | np.generic | torch.Tensor):
        return value.tolist()
    return value


def _to_tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _to_tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(_to_tuples(item) for item in value)
    return value

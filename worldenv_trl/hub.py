"""The Hugging Face Hub as a place of checkpoints, through ``huggingface_hub``, imported only when it is asked."""

from __future__ import annotations

import os
import re
from pathlib import Path

_REPO_ID = re.compile(r"\w[\w\-.]{0,95}/\w[\w\-.]{0,95}", re.ASCII)


def is_repo_id(name: str | os.PathLike) -> bool:
    """Whether a name means a repository of the Hub, ``owner/name``, and no folder.

    A ``Path`` never does, nor does what exists on this machine, nor a name below a folder that exists.

    Examples:
        >>> is_repo_id("someone/arm"), is_repo_id("runs/arm/checkpoints/sft"), is_repo_id("./arm"), is_repo_id("arm")
        (True, False, False, False)
    """
    if not isinstance(name, str) or not _REPO_ID.fullmatch(name) or ".." in name or "--" in name:
        return False
    return not Path(name).exists() and not Path(name).parent.is_dir()


def download(repo_id: str, files: list[str], *, revision: str | None = None) -> Path:
    """The folder of a repository's ``files`` in the Hub's cache on this machine, brought there if need be.

    Raises:
        FileNotFoundError: if the repository cannot be had, saying what was tried and the remedy.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HTTPError

    try:
        return Path(snapshot_download(repo_id, revision=revision, allow_patterns=files))
    except (OSError, ValueError, HTTPError) as error:
        raise FileNotFoundError(
            f"there is no folder {repo_id}, and the Hugging Face Hub gave no repository of this id "
            f"({_said(error)}): name a local folder, or load it once with a connection; the copy in the cache is then "
            "found without one, too (HF_HUB_OFFLINE=1)"
        ) from error


def upload(folder: str | os.PathLike, repo_id: str, *, private: bool | None, revision: str | None, message: str) -> str:
    """Uploads a folder into a repository of the Hub, made if it does not exist; returns the address of the commit.

    Raises:
        ValueError: if ``repo_id`` is not ``owner/name``.
        OSError: if the Hub refuses or cannot be reached.
    """
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HTTPError

    if not _REPO_ID.fullmatch(repo_id):
        raise ValueError(f"a repository of the Hub is named owner/name, got {repo_id!r}")
    api = HfApi()
    try:
        api.create_repo(repo_id, private=private, exist_ok=True)
        if revision is not None:
            api.create_branch(repo_id, branch=revision, exist_ok=True)
        commit = api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message, revision=revision)
    except (OSError, ValueError, HTTPError) as error:
        raise OSError(
            f"nothing was uploaded to {repo_id} ({_said(error)}): check the connection, and log in with `hf auth login`"
        ) from error
    return str(commit.commit_url)


def _said(error: Exception) -> str:
    """The first sentence of one of the Hub's messages, which run over many lines."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0].rstrip(".:") if lines else type(error).__name__

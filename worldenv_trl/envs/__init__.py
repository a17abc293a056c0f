"""Environments: physics, imagination, and the reflector's reward and stop.

Names are imported when they are first used: imagination needs neither MuJoCo nor GL, which the physics loads.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from worldenv_trl.context_ids import context_id
    from worldenv_trl.envs.chunking import ChunkedActions, chunked
    from worldenv_trl.envs.expert import ExpertPolicy
    from worldenv_trl.envs.frames_aside import FramesAside
    from worldenv_trl.envs.imagined import ImaginedEnv
    from worldenv_trl.envs.init_states import InitStates
    from worldenv_trl.envs.reflect import Reflect
    from worldenv_trl.envs.tabletop import TabletopEnv

__all__ = [
    "ChunkedActions",
    "ExpertPolicy",
    "FramesAside",
    "ImaginedEnv",
    "InitStates",
    "Reflect",
    "TabletopEnv",
    "chunked",
    "context_id",
]

_HOMES = {
    "ChunkedActions": "worldenv_trl.envs.chunking",
    "ExpertPolicy": "worldenv_trl.envs.expert",
    "FramesAside": "worldenv_trl.envs.frames_aside",
    "ImaginedEnv": "worldenv_trl.envs.imagined",
    "InitStates": "worldenv_trl.envs.init_states",
    "Reflect": "worldenv_trl.envs.reflect",
    "TabletopEnv": "worldenv_trl.envs.tabletop",
    "chunked": "worldenv_trl.envs.chunking",
    "context_id": "worldenv_trl.context_ids",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

"""Environments: physics, imagination, and the reflector's reward and stop."""

from worldenv_trl.envs.chunking import ChunkedActions, chunked
from worldenv_trl.envs.expert import ExpertPolicy
from worldenv_trl.envs.imagined import ImaginedEnv
from worldenv_trl.envs.init_states import InitStates, context_id
from worldenv_trl.envs.reflect import Reflect
from worldenv_trl.envs.tabletop import TabletopEnv

__all__ = [
    "ChunkedActions",
    "ExpertPolicy",
    "ImaginedEnv",
    "InitStates",
    "Reflect",
    "TabletopEnv",
    "chunked",
    "context_id",
]

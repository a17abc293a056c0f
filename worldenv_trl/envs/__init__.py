"""Environments: physics, imagination, and the reflector's reward and stop."""

from worldenv_trl.envs.chunking import ChunkedActions, chunked
from worldenv_trl.envs.imagined import ImaginedEnv
from worldenv_trl.envs.tabletop import TabletopEnv

__all__ = ["ChunkedActions", "ImaginedEnv", "TabletopEnv", "chunked"]

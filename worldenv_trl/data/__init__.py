"""Rollouts as training batches: episodes, where their frames are, and what each learned part draws from them."""

from worldenv_trl.data.corrected import corrected_samples, until_reached
from worldenv_trl.data.episodes import Episodes
from worldenv_trl.data.from_rollouts import episodes_from_rollouts
from worldenv_trl.data.hdf5 import hdf5_to_mcap, read_hdf5
from worldenv_trl.data.imagine import ImaginedSoFar, imagine_episodes
from worldenv_trl.data.lerobot import write_lerobot
from worldenv_trl.data.lerobot_reader import read_lerobot
from worldenv_trl.data.libero import ACTIONS, LiberoFile, inspect_libero, read_libero
from worldenv_trl.data.samples import gripper_changes, policy_samples, with_images
from worldenv_trl.data.score import score_episodes
from worldenv_trl.data.store import fill_store, open_store
from worldenv_trl.data.windows import WindowBuffer, WindowSampler, predicted_poses, window_buffer

__all__ = [
    "ACTIONS",
    "Episodes",
    "ImaginedSoFar",
    "LiberoFile",
    "WindowBuffer",
    "WindowSampler",
    "corrected_samples",
    "episodes_from_rollouts",
    "fill_store",
    "gripper_changes",
    "hdf5_to_mcap",
    "imagine_episodes",
    "inspect_libero",
    "open_store",
    "policy_samples",
    "predicted_poses",
    "read_hdf5",
    "read_lerobot",
    "read_libero",
    "score_episodes",
    "until_reached",
    "window_buffer",
    "with_images",
    "write_lerobot",
]

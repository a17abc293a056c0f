"""LIBERO's demonstration files as the stages use them: tasks that bring their demonstrations along."""

from __future__ import annotations

from collections.abc import Iterator

from tqdm import tqdm

from config import WorldEnvConfig
from parts import instructions
from physics import recording, tabletop
from run import Run
from worldenv_trl.data import LiberoFile, episodes_from_rollouts, inspect_libero, predicted_poses, read_libero
from worldenv_trl.hdf5_file import SUFFIXES
from worldenv_trl.record import RolloutWriter


def from_libero(config: WorldEnvConfig) -> bool:
    """Whether the demonstrations are those of files."""
    return all(task.endswith(SUFFIXES) for task in config.tasks) and bool(config.tasks)


def check_files(config: WorldEnvConfig) -> None:
    """Looks through all files; images stay on the disk.

    Raises:
        ImportError: without h5py.
        ValueError: naming the file that does not suit the run, and what to do.
    """
    if not any(task.endswith(SUFFIXES) for task in config.tasks):
        return
    other = [task for task in config.tasks if not task.endswith(SUFFIXES)]
    if other:
        raise ValueError(f"tasks must be LIBERO's files, all or none: {other[0]} is none")
    for path, found, count in _inspected(config):
        missing = [camera for camera in config.cameras if camera not in found.cameras]
        if missing:
            raise ValueError(
                f"{path} shows {', '.join(found.cameras)}, the run's cameras are {', '.join(config.cameras)}: "
                f"--cameras {' '.join(found.cameras)}"
            )
        if found.size_px != config.image_size:
            raise ValueError(
                f"{path} holds images of {found.size_px} px, the run's are of {config.image_size}: --image-size "
                f"{found.size_px} (for others OpenVLA-OFT's script makes LIBERO's files anew)"
            )
        if len(found.demonstrations) < count:
            raise ValueError(
                f"{path} holds {len(found.demonstrations)} demonstrations that reach the goal, "
                f"demonstrate.episodes_per_task is {count}: --demonstrate.episodes-per-task {len(found.demonstrations)}"
            )
        longest = max(found.steps[:count])
        if longest > config.max_steps and config.demonstrate.actions == "path":
            enough = -(-longest // config.chunk_length) * config.chunk_length
            raise ValueError(
                f"{path} holds a demonstration of {longest} steps, max_steps is {config.max_steps}: "
                f"--max-steps {enough} or more"
            )


def told(config: WorldEnvConfig) -> list[str]:
    """Lines of a plan: what would be learned from. None without files."""
    if not from_libero(config):
        return []
    files = list(_inspected(config))
    steps = [sum(found.steps[:count]) for _, found, count in files]
    taken, failed = sum(count for *_, count in files), sum(found.failed for _, found, _ in files)
    kept, size = sum(steps), files[0][1].size_px
    frames = (kept + taken) * len(config.cameras)
    return [
        f"demonstrations: {taken} of {len(files)} files of LIBERO's, {kept:,} steps ({failed} failures and "
        f"{sum(found.no_ops for _, found, _ in files):,} no-ops left out), actions {config.demonstrate.actions!r}",
        f"demonstrations: {frames:,} frames of {', '.join(config.cameras)} at {size} px, "
        f"{frames * 3 * size * size / 1e9:.2f} GB as they are",
    ]


def convert(run: Run) -> None:
    """Writes ``rollouts/demonstrations.mcap`` from the files."""
    config, folder = run.config, run.folder
    described = tabletop(config, "train", len(config.tasks), None)
    about = recording(config, described, "demonstrate", actions=config.demonstrate.actions)
    described.close()
    about["metadata"]["env"]["max_steps"] = max(max(found.steps[:count]) for _, found, count in _inspected(config))
    kinematics = run.parts.kinematics()
    texts = instructions(config)
    with RolloutWriter(folder.rollouts("demonstrations"), **about, overwrite=True) as writer:
        for number, (path, found, count) in enumerate(tqdm(list(_inspected(config)), desc="demonstrate", unit="file")):
            strayed, steps = [], []
            for rollout in read_libero(
                path,
                kinematics,
                instruction=texts[number],
                task_id=number,
                actions=config.demonstrate.actions,
                cameras=config.cameras,
                demonstrations=found.demonstrations[:count],
            ):
                writer.write(rollout)
                episode = episodes_from_rollouts(rollout)
                lived = kinematics.pose(episode["kinematic_states"])[..., :3]
                strayed.append((predicted_poses(episode, kinematics)[..., :3] - lived).norm(dim=-1).mean())
                steps.append(rollout.shape[-1])
            folder.log(
                "demonstrate",
                task=config.tasks[number],
                episodes=count,
                steps=sum(steps) / count,
                # Of forward kinematics from the recorded path: what the world model would be told wrongly.
                strayed_m=(sum(strayed) / count).item(),
            )


def _inspected(config: WorldEnvConfig) -> Iterator[tuple[str, LiberoFile, int]]:
    """Each file, what it holds, and how many demonstrations of it are wanted."""
    for path in config.tasks:
        yield path, inspect_libero(path, actions=config.demonstrate.actions), config.demonstrate.episodes_per_task

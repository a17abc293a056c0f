"""What is wrong with settings, or seldom meant so, before any long work starts."""

from __future__ import annotations

from collecting import check_collectors
from config import WorldEnvConfig
from data_parallel import MODES
from libero_files import check_files, from_libero
from loggers import check_loggers
from parts import COMPACT, Parts, check_fits
from physics import tabletop
from ranges import check_ranges
from worldenv_trl.data import ACTIONS
from worldenv_trl.devices import choose_device
from worldenv_trl.hdf5_file import SUFFIXES
from worldenv_trl.policies import Policy, TokenPolicy
from worldenv_trl.policies.actor import NOISES
from worldenv_trl.reflectors import StopRule
from worldenv_trl.scenes import load_task


def check_shares(config: WorldEnvConfig, processes: int) -> None:
    """Raises ``ValueError`` naming the setting that so many processes cannot share out equally."""
    for name, value in (
        ("sft.batch_size", config.sft.batch_size),
        ("world_model.batch_size", config.world_model.batch_size),
        ("reflector.batch_size", config.reflector.batch_size),
        ("post_train.groups", config.post_train.groups),
    ):
        if value % processes:
            raise ValueError(f"{name} must be a multiple of the {processes} processes that share it, got {value}")
    if processes > 1 and config.collectors != "local":
        raise ValueError(
            f"{processes} processes of torchrun roll out their own groups: collectors must be local, got "
            f"{config.collectors!r}; workers serve a single process"
        )


def check_loop(config: WorldEnvConfig, policy: Policy) -> None:
    """Raises ``ValueError`` for a ratio that policy or noise does not have, and if it has no mean to be kept."""
    level = config.post_train.ratio_level
    if isinstance(policy, TokenPolicy) and policy.sequential and level == "step":
        raise ValueError(
            f"post_train.ratio_level must be chunk or token for {type(policy).__name__}, whose tokens belong to whole "
            "chunks, got 'step'"
        )
    if level == "token" and not isinstance(policy, TokenPolicy):
        raise ValueError(
            f"post_train.ratio_level must be step or chunk for {type(policy).__name__}, which does not act by tokens, "
            "got 'token'"
        )
    if level == "chunk" and config.post_train.noise == "chunk" and not isinstance(policy, TokenPolicy):
        raise ValueError(
            "post_train.ratio_level must be step with post_train.noise='chunk', where each step has its chunk's ratio, "
            "got 'chunk'"
        )
    for name, value in (("post_train.hold", config.post_train.hold), ("adapt.steps", config.adapt.steps)):
        if isinstance(policy, TokenPolicy) and value:
            raise ValueError(
                f"{name} is for policies with a mean, and {type(policy).__name__} acts by tokens: it must be 0, "
                f"got {value:g}"
            )


def check_config(config: WorldEnvConfig, parts: Parts = COMPACT) -> None:
    """Fails before any long work starts if a task is unknown, a setting impossible, a device missing or no
    GL backend renders.

    What only the compact parts refuse is found by making those of them that ``parts`` holds, what others do by their
    outlines, where there are any: they may take long to make.

    Raises:
        ValueError: naming the setting.
        RuntimeError: if nothing can be drawn.
    """
    choose_device(config.device)
    if not config.cameras:
        raise ValueError("cameras is empty: name at least one, for instance agentview")
    if not config.tasks:
        raise ValueError("tasks is empty: name at least one task, for instance starter/open_the_top_drawer")
    if len(set(config.tasks)) < len(config.tasks):
        raise ValueError(f"tasks names a task twice: {', '.join(config.tasks)}")
    for name, value, known in (
        ("post_train.env", config.post_train.env, ("imagined", "tabletop")),
        ("post_train.ratio_level", config.post_train.ratio_level, ("step", "chunk", "token")),
        ("explore.noise", config.explore.noise, tuple(NOISES)),
        ("post_train.noise", config.post_train.noise, tuple(NOISES)),
        ("parallel", config.parallel, MODES),
        ("demonstrate.actions", config.demonstrate.actions, ACTIONS),
        ("demonstrate.states", config.demonstrate.states, ("first", "spread")),
    ):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    unseen = [camera for camera in config.sft.cameras if camera not in config.cameras]
    if unseen:
        raise ValueError(
            f"sft.cameras must be of the run's cameras, {', '.join(config.cameras)}, got {', '.join(unseen)}: "
            "add them to cameras"
        )
    check_ranges(config)
    wanted = config.demonstrate.episodes_per_task
    if config.demonstrate.states == "spread" and wanted > config.train_states and not from_libero(config):
        raise ValueError(
            f"demonstrate.episodes_per_task must be at most {config.train_states}, train_states, where the states are "
            f"spread, got {wanted}"
        )
    if not 32 <= config.image_size <= 4096 or config.image_size % 16:
        raise ValueError(f"image_size must be a multiple of 16 px from 32 to 4096, got {config.image_size}")
    if not 0 <= config.sft.shift_px < config.image_size:
        raise ValueError(
            f"sft.shift_px must be at least 0 and less than image_size, {config.image_size}, got {config.sft.shift_px}"
        )
    if config.sft.aim_weight and config.sft.shift_px:
        raise ValueError(
            f"sft.aim_weight needs sft.shift_px 0, got {config.sft.shift_px}: the random shift moves the image and not "
            "the place that is aimed at; sft.scene_shift_m moves both"
        )
    for name, rows, dealt in (
        ("explore.num_envs", config.explore.num_envs, True),
        ("post_train.groups", config.post_train.groups, config.post_train.env == "tabletop"),
    ):
        if dealt and rows < len(config.tasks):
            raise ValueError(f"{name} must be at least {len(config.tasks)}, one for each task, got {rows}")
    if not config.explore.scale_factors:
        raise ValueError("explore.scale_factors is empty: name at least one, for instance 1")
    factors = ", ".join(f"{factor:g}" for factor in config.explore.scale_factors)
    if len(set(config.explore.scale_factors)) < len(config.explore.scale_factors):
        raise ValueError(
            f"explore.scale_factors names a factor twice, {factors}: each has as many rollouts; for more of them raise "
            "explore.episodes_per_task"
        )
    for setting, asked, why in (
        ("post_train.hold", bool(config.post_train.hold), "asks what greedy rollouts solved"),
        ("adapt.correct_steps", config.adapt.steps and config.adapt.correct_steps, "keeps what greedy rollouts do"),
    ):
        if asked and 0.0 not in config.explore.scale_factors:
            raise ValueError(f"{setting} {why}: explore.scale_factors must hold 0, got {factors}")
    if config.post_train.trust and not config.post_train.hold:
        raise ValueError(
            f"post_train.trust={config.post_train.trust:g} holds tasks: post_train.hold must be above 0, for instance 1"
        )
    if config.post_train.env == "tabletop":
        for name, count, least in (("adapt.steps", config.adapt.steps, 0), ("rounds", config.rounds, 1)):
            if count > least:
                raise ValueError(
                    f"{name} is of imagination: it must be {least} where post_train.env is tabletop, got {count}"
                )
    try:
        StopRule(config.reflector.threshold, config.reflector.consecutive)
    except ValueError as error:
        raise ValueError(f"reflector.{error}") from error
    if config.max_steps % config.chunk_length:
        raise ValueError(f"max_steps must be a multiple of chunk_length={config.chunk_length}, got {config.max_steps}")
    check_loggers(config.logger)
    check_collectors(config)
    check_files(config)
    digests: dict[str, str] = {}
    for name in config.tasks:
        digest = load_task(name).digest
        if digest in digests:
            raise ValueError(f"tasks names a task twice: {digests[digest]} and {name} say the same")
        digests[digest] = name
    cell = 2 * config.world_model.patch
    if config.image_size % cell:
        raise ValueError(
            f"image_size must be a multiple of twice world_model.patch={config.world_model.patch}, "
            f"got {config.image_size}"
        )
    tabletop(config, "train", len(config.tasks), None).close()
    for name in ("policy", "world_model", "reflector"):
        part = getattr(parts, name)
        make = part.make if part is getattr(COMPACT, name) else part.outline
        if make is not None:
            try:
                made = make(config)
                check_fits(config, made)
                if name == "policy":
                    check_loop(config, made)
            except ValueError as error:
                raise ValueError(f"the {name.replace('_', ' ')} cannot be made of these settings: {error}") from error


def doubts(config: WorldEnvConfig) -> list[str]:
    """What checked settings allow and is seldom meant, a line each."""
    lines = []
    if config.adapt.correct_steps and not config.adapt.steps:
        lines.append(f"adapt.correct_steps={config.adapt.correct_steps} is not read: adapt.steps is 0")
    of_suites = [load_task(name) for name in config.tasks if not name.endswith((".bddl", *SUFFIXES))]
    longest = max(of_suites, key=lambda task: task.max_steps, default=None)
    if longest is not None and longest.max_steps > config.max_steps:
        enough = -(-longest.max_steps // config.chunk_length) * config.chunk_length
        lines.append(
            f"max_steps={config.max_steps} ends rollouts before the {longest.max_steps} steps of {longest.name}: "
            f"--max-steps {enough}"
        )
    return lines

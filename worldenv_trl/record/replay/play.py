"""Recorded rollouts once more: the same, in another model, or with something changed."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from worldenv_trl.devices import device_of
from worldenv_trl.keys import MASK, NUM_STEPS, SUCCESS, SUCCESS_PROB
from worldenv_trl.record.mcap.provenance import model_hash, package_versions
from worldenv_trl.record.mcap.reader import list_rollouts, read_attachments, read_rollouts
from worldenv_trl.record.mcap.recording import Recording
from worldenv_trl.record.mcap.writer import RolloutWriter
from worldenv_trl.record.replay.beside import laid_beside
from worldenv_trl.record.replay.branch import Branch, check_edits
from worldenv_trl.record.replay.physics import replay_physics, state_parts
from worldenv_trl.record.replay.report import Divergence, ReplayReport, compare, frame_psnr
from worldenv_trl.record.replay.source import Source, observed, open_rollout

if TYPE_CHECKING:
    from worldenv_trl.reflectors import Reflector, StopRule
    from worldenv_trl.world_models import WorldModel

__all__ = ["replay"]

MODES = ("physics", "imagination")
_RULE = re.compile(r"(threshold|consecutive)=([\d.eE+-]+)")


def replay(
    path: str | os.PathLike,
    rollout: int = 0,
    *,
    mode: str | None = None,
    world_model: WorldModel | None = None,
    reflector: Reflector | None = None,
    from_step: int = 0,
    policy: TensorDictModuleBase | None = None,
    seed: int | None = None,
    threshold: float | None = None,
    edits: Mapping[int, Mapping[int, float]] | None = None,
    target: str | os.PathLike | None = None,
    write: bool = True,
    overwrite: bool = False,
) -> ReplayReport:
    """Plays a recorded rollout again and says what differs and where.

    *Physics* starts from the recorded state and takes the recorded actions: bit-exact with the same versions. Without
    a recorded state it starts from the initial state that the context id names. *Imagination* takes the recorded
    actions and noise seeds; frames are equal if the world model is the recorded one. With ``policy``, ``seed``,
    ``threshold`` or ``edits`` it is a *what-if* that leaves the recording at ``from_step``.

    What was played goes into a new file beside the old one, ``<name>_rollout<K>_<kind>.mcap``, whose metadata name
    source, rollout, branch and report. A step of it shows the recorded image, too.

    Args:
        path: one recording.
        rollout: its number there.

    Keyword Args:
        mode: ``physics`` or ``imagination``; as recorded by default. The other one gives a difference curve.
        world_model: needed for imagination. If its hash is not the recorded one, differences are shown and equality
            is not claimed.
        reflector: stops the replay by the recorded rule (the paper's if the file does not say) and scores it; only the
            frames are compared without.
        from_step: env step to begin at. Physics begins at the last recorded state that is not behind it; imagination
            branches at the decision that holds it.
        policy: an actor that acts from ``from_step`` on; greedy without ``seed``.
        seed: of the policy's samples, and of the world model's noise from ``from_step`` on.
        threshold: of ``reflector`` from ``from_step`` on, in (0, 1).
        edits: {step: {action dimension: value}}, see :func:`~worldenv_trl.record.parse_edit`.
        target: another name for the new file.
        write: whether to write it.
        overwrite: replace a file of that name.

    Raises:
        FileNotFoundError, ValueError: as :func:`~worldenv_trl.record.read_rollouts`; for a rollout without actions, an
            imagined one whose first steps are not in the file, a step that it does not have, a part that is missing,
            or a change that can have no effect.
        FileExistsError: if the new file exists.

    Examples:
        >>> import tempfile
        >>> from worldenv_trl.envs import TabletopEnv
        >>> from worldenv_trl.record import provenance, recorded
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     base = TabletopEnv("starter/open_the_top_drawer", 2, seed=0)
        ...     env = recorded(base, f"{folder}/demo.mcap", **provenance(base))
        ...     rollout = env.rollout(8)
        ...     env.close()
        ...     again = replay(f"{folder}/demo.mcap", 1)
        ...     changed = replay(f"{folder}/demo.mcap", 1, edits={3: {2: 1.0}})  # upwards
        >>> again.exact, changed.kind, changed.divergences[0].step
        (True, 'what-if', 4)
    """
    source = open_rollout(path, rollout)
    begun = source.entries[0].get(NUM_STEPS, None)
    if source.imagined and begun is not None and int(begun):
        raise ValueError(
            f"rollout {source.number} of {source.path} begins at step {int(begun)}: the world model remembers frames "
            "before it, which the file does not hold, so it cannot be replayed. Record rollouts from their beginning"
        )
    mode = mode or ("imagination" if source.imagined else "physics")
    branch = _branch(source, mode, world_model, reflector, from_step, policy, seed, threshold, edits or {})
    kind = "what-if" if branch else "exact"
    target = _target(source, mode, branch, target) if write else None
    if target is not None and target.exists() and not overwrite:
        raise FileExistsError(f"{target} exists: pass overwrite=True or another target")

    notes: list[str] = []
    if branch is not None and mode == "imagination" and world_model is not None:
        branch = _of_a_decision(branch, world_model.chunk_length, notes)
    recorded = observed(source.entries)
    given = reflector
    reflector = None if given is None else _judge(source, given, mode)
    rule = _rule(source, reflector)
    unchanged = None
    with torch.random.fork_rng(devices=[]):  # a branch seeds the policy's samples
        if mode == "physics":
            played, first = replay_physics(source, branch, from_step, reflector, rule, notes)
        else:
            options = {"world_model": world_model, "reflector": reflector, "rule": rule}
            played, unchanged = _imagined(source, branch, from_step, notes, **options)
            first = 0
    same = _same_versions(source, notes) and source.imagined == (mode == "imagination")
    if mode == "imagination" and source.imagined and world_model is not None:
        same = _same_model(source, "world_model", world_model, notes) and same
        same = _same_device(source, device_of(world_model).type, notes) and same
    if given is not None and reflector is not None:
        same = _same_judge(source, given, reflector, mode, notes) and same
    if kind == "exact" and (source.imagined != (mode == "imagination") or not same):
        kind = "difference"
    shown = observed(played, first)
    parts = state_parts(source) if mode == "physics" and not source.imagined else ()
    against = recorded if unchanged is None else observed(unchanged)
    divergences, compared = compare(against, shown, after=branch.step if branch else -1, state_parts=parts)
    end = max(int(steps.max()) for steps, _ in shown.values())
    before = source.steps if unchanged is None else max(int(steps.max()) for steps, _ in against.values())
    # Without its reflector an imagined rollout plays its last chunk to the end.
    if end < before or (end > before and (branch is not None or reflector is not None)):
        words = f"the recording ends at step {before}, the replay at step {end}"
        if unchanged is not None:
            words = f"without the change it ends at step {before}, with it at step {end}"
        divergences.append(Divergence(min(end, before), "end", abs(end - before), words))
        divergences.sort(key=lambda each: each.step)
    elif end > before:
        notes.append(f"without a reflector nothing stops it before its last chunk ends, at step {end}")
    report = ReplayReport(
        source=source.path,
        rollout=rollout,
        mode=mode,
        kind=kind,
        exact=(not divergences and bool(compared)) if kind == "exact" else None,
        first_step=first,
        steps=end,
        recorded_steps=source.steps,
        compared=tuple(compared),
        divergences=tuple(divergences),
        psnr=frame_psnr(against, shown),
        outcome={"recorded": _outcome(source.entries), "replayed": _outcome(played, first)},
        branch={} if branch is None else branch.describe(),
        notes=tuple(notes),
        target=target,
    )
    if target is not None:
        models = {"world_model": world_model, "reflector": reflector, "policy": policy}
        _write(source, played, report, recorded, target, overwrite, models)
    return report


def _branch(
    source: Source,
    mode: str,
    world_model: WorldModel | None,
    reflector: Reflector | None,
    from_step: int,
    policy: TensorDictModuleBase | None,
    seed: int | None,
    threshold: float | None,
    edits: Mapping[int, Mapping[int, float]],
) -> Branch | None:
    """Checks what was asked for; None if nothing is changed."""
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}, got {mode!r}")
    if not 0 <= from_step < source.steps:
        raise ValueError(f"rollout {source.number} of {source.path} has steps 0 to {source.steps - 1}, not {from_step}")
    if mode == "imagination" and world_model is None:
        raise ValueError(f"rollout {source.number} of {source.path} is replayed in imagination: pass its world_model")
    if threshold is not None and reflector is None:
        raise ValueError("threshold is the reflector's: pass a reflector, too")
    if threshold is not None and not 0 < threshold < 1:
        raise ValueError(f"threshold must be in (0, 1), got {threshold}")
    if seed is not None and policy is None and mode == "physics":
        raise ValueError("a seed changes nothing in the physics without a policy: pass a policy, or no seed")
    check_edits(edits)
    if edits and policy is None and max(edits) >= source.steps:
        raise ValueError(f"the recorded actions end at step {source.steps - 1}, an edit names {max(edits)}")
    if edits and from_step and min(edits) < from_step:
        raise ValueError(f"the branch is at step {from_step}, an edit names the step {min(edits)} before it")
    step = min(edits) if edits and not from_step and policy is seed is threshold is None else from_step
    branch = Branch(step, policy, seed, threshold, edits)
    return branch if branch.changes else None


def _of_a_decision(branch: Branch, length: int, notes: list[str]) -> Branch:
    """In imagination policy and noise change from one decision of ``length`` steps to the next."""
    past = branch.step % length
    if not past or (branch.policy is None and branch.seed is None):
        return branch
    notes.append(f"a decision takes {length} steps: the branch is at step {branch.step - past}, not {branch.step}")
    return replace(branch, step=branch.step - past)


def _imagined(
    source: Source, branch: Branch | None, from_step: int, notes: list[str], **options: Any
) -> tuple[TensorDict, TensorDict | None]:
    """The rollout in imagination; for a what-if also what happens there when nothing is changed."""
    from worldenv_trl.record.replay.imagination import chunks_of, replay_imagination  # reading needs no world models

    world_model = options["world_model"]
    length = world_model.chunk_length
    rollouts = chunks_of(source, length, world_model.cameras)
    known = source.env.get("max_steps", source.steps) if source.imagined else source.steps
    options["max_steps"] = max(known) if isinstance(known, list) else max(int(known), source.steps)
    options["proprio"] = source.env.get("proprio", "commanded")
    if branch is not None:
        # The change is told apart from another model and from rounding by playing both.
        unchanged = replay_imagination(rollouts, branch=Branch(branch.step), **options)[0]
        notes.append("compared with the same model without the change")
        return replay_imagination(rollouts, branch=branch, **options)[0], unchanged
    options["branch"] = Branch(from_step) if from_step else None  # earlier frames are taken as recorded
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(int(source.metadata.get("threads", threads)))
        played = replay_imagination(rollouts, **options)[0]
        hashed = source.models.get("world_model") == model_hash(world_model)
        if not source.imagined or not hashed or not compare(observed(source.entries), observed(played))[0]:
            return played, None
        wave = _wave(source)
        if wave is None:
            return played, None
        # Sums over more rows are taken in another order, so that a pixel may be rounded to its neighbour.
        notes.append(f"alone, rounding makes a difference: replayed with the {len(wave[0])} rows of its wave")
        together = replay_imagination(wave[0], group=wave[2], **options)[wave[1]]
        return together[together[MASK]], None
    finally:
        torch.set_num_threads(threads)


def _wave(source: Source) -> tuple[TensorDict, int, int] | None:
    """All rollouts that were imagined together with this one [R, D], its place among them, and the size of groups."""
    batch, written = source.env.get("batch_size", []), Recording(source.path).written
    part = next((part for part in written if source.number in part.numbers), None)
    if len(batch) != 2:
        return None
    rows, numbers = batch[0] * batch[1], [] if part is None else list(part.numbers)
    if len(numbers) % rows:  # a wave may have been written in several parts, one after the other
        numbers = [number for each in written for number in each.numbers]
    if part is None:  # a recorder's: the rows that began as often
        infos = [(info.row, info) for info in list_rollouts(source.path) if info.row is not None]
        episode = next((info.episode for _, info in infos if info.number == source.number), None)
        here = sorted((row, info.number) for row, info in infos if info.episode == episode)
        numbers = [number for _, number in here]
    if source.number not in numbers or len(numbers) % rows:
        return None
    place = numbers.index(source.number)
    first = place - place % rows
    wave = numbers[first : first + rows]
    found = read_rollouts(source.path, rollouts=wave)  # in the order of the file
    order = torch.tensor([sorted(wave).index(number) for number in wave])
    return found[order], place % rows, batch[1]


def _rule(source: Source, reflector: Reflector | None) -> StopRule | None:
    """The recorded stopping rule, else the paper's."""
    if reflector is None:
        return None
    from worldenv_trl.reflectors import StopRule  # reading needs no reflectors

    described = next((text for text in source.env.get("transforms", []) if text.startswith("Reflect(")), "")
    found = dict(_RULE.findall(described))
    return StopRule(float(found.get("threshold", StopRule.threshold)), int(found.get("consecutive", 1)))


def _judge(source: Source, reflector: Reflector, mode: str) -> Reflector:
    """The one of ``reflector`` that judges there (``for_world``); in the physics all of it, if so recorded."""
    if mode == "physics" and source.models.get("reflector") == model_hash(reflector):
        return reflector
    return reflector.for_world("imagined" if mode == "imagination" else "real")


def _same_versions(source: Source, notes: list[str]) -> bool:
    recorded, now = source.metadata.get("versions"), package_versions()
    if recorded is None:
        notes.append("the file does not name the versions it was recorded with: equality is not claimed")
        return False
    changed = [f"{name} {recorded[name]} -> {now[name]}" for name in now if recorded.get(name, now[name]) != now[name]]
    if changed:
        notes.append(f"recorded with other versions: {', '.join(changed)}; equality is not claimed")
    return not changed


def _same_model(source: Source, name: str, model: torch.nn.Module, notes: list[str]) -> bool:
    recorded, given = source.models.get(name), model_hash(model)
    if recorded is None:
        notes.append(f"the file does not name its {name}: differences are shown, equality is not claimed")
    elif recorded != given:
        notes.append(
            f"the {name} is not the recorded one (SHA-256 {recorded[:8]} was recorded, {given[:8]} is given): "
            "differences are shown, equality is not claimed"
        )
    return recorded == given


def _same_judge(source: Source, given: Reflector, judging: Reflector, mode: str, notes: list[str]) -> bool:
    if source.imagined != (mode == "imagination"):
        there = given.for_world("imagined" if source.imagined else "real")
        if source.models.get("reflector") == model_hash(there) != model_hash(judging):
            notes.append("the reflector's other part judges this world: its R is not the recorded one's")
            return False
    return _same_model(source, "reflector", judging, notes)


def _same_device(source: Source, given: str, notes: list[str]) -> bool:
    recorded = source.metadata.get("device", given)
    if recorded != given:
        notes.append(
            f"recorded on {recorded}, replayed on {given}: sums are rounded and noise is drawn otherwise there; "
            "equality is not claimed"
        )
    return recorded == given


def _outcome(entries: TensorDict, first: int = 0) -> dict[str, float | bool | int]:
    out: dict[str, float | bool | int] = {}
    have = set(entries.keys(True, True))
    out["last step"] = first + max(int(steps.max()) for steps, _ in observed(entries).values())
    if ("next", SUCCESS) in have:
        out["success"] = bool(entries["next", SUCCESS][-1])
    if ("next", SUCCESS_PROB) in have:
        out["success_prob"] = float(entries["next", SUCCESS_PROB][-1])
        out["stopped"] = bool(entries["next", "terminated"][-1])
    return out


def _target(source: Source, mode: str, branch: Branch | None, target: str | os.PathLike | None) -> Path:
    if target is not None:
        path = Path(target)
        if path.exists() and path.samefile(source.path):
            raise ValueError(f"{path} is the recording itself: a replay needs another target")
        return path
    kind = f"whatif{branch.step}" if branch else "replay"
    if source.imagined != (mode == "imagination"):
        kind += f"_{mode}"
    return source.path.with_name(f"{source.path.stem}_rollout{source.number}_{kind}.mcap")


def _write(
    source: Source,
    played: TensorDict,
    report: ReplayReport,
    recorded: Mapping[str, tuple[Tensor, Tensor]],
    target: Path,
    overwrite: bool,
    models: Mapping[str, torch.nn.Module | None],
) -> None:
    """The replay as a recording, each step with what was recorded of it."""
    played = laid_beside(played, recorded, report.first_step, report.psnr)
    imagined, taking_part = report.mode == "imagination", [model for model in models.values() if model is not None]
    described = dict(source.metadata) | {
        "versions": package_versions(),
        "models": {name: model_hash(model) for name, model in models.items() if model is not None},
        "env": source.env
        | {"class": "ImaginedEnv" if imagined else "TabletopEnv", "batch_size": [1, 1] if imagined else [1]},
        "replay": {
            "source": source.path.name,
            "rollout": source.number,
            "mode": report.mode,
            "kind": report.kind,
            "first_step": report.first_step,
            "branch": report.branch,
            "report": report.to_json(),
        },
    }
    if taking_part:
        described["device"] = device_of(taking_part[0]).type
    with RolloutWriter(
        target, metadata=described, attachments=read_attachments(source.path), overwrite=overwrite
    ) as writer:
        writer.write(played.unsqueeze(0))

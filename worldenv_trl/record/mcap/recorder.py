"""Records rollouts while an env runs."""

from __future__ import annotations

import difflib
import multiprocessing
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, MultiAction, Transform, TransformedEnv

from worldenv_trl.keys import EPISODE, ROW
from worldenv_trl.record.mcap.file import check_target
from worldenv_trl.record.mcap.layout import leaves, to_bytes
from worldenv_trl.record.mcap.stream import RolloutStream

if TYPE_CHECKING:
    from worldenv_trl.kinematics import ActionMap, ForwardKinematics

__all__ = ["Recorder", "recorded"]

_Path = tuple[str, ...]
_DEFAULT_STEPS = 1000


class Recorder(Transform):
    """Records every rollout of the env it is around, while a rollout or a collector runs: the last transform.

    Each row's rollouts are written as they happen, in a thread of its own behind a bounded queue, so that the env waits
    only if the disk cannot follow; at most a second of it is lost when the process is killed. :func:`read_rollouts`
    gives one rollout for each reset of a row [R, T], in the order in which they began, with the entries of the env and
    the policy and in addition

    - ``row`` and ``episode``: the env's row, and how many rollouts it had begun before;
    - ``("next", "termination")``: why the rollout ended, index into ``keys.TERMINATIONS``; 0 while it goes on;
    - ``("next", "predicted_state")``, with ``kinematics``: what forward kinematics predicts from the step before;
    - ``("next", "action_map")``, with ``action_map``: the hand drawn for the eye.

    The file appears under its name when the env is closed; until then it is ``<name>.partial.mcap``. It is opened at
    the first step, in the process that steps: in a worker process, its name is ``<name>_<worker>.mcap``.

    Around a chunked env it records decisions and must not be unwrapped: use :func:`recorded`.

    Args:
        path: ends in ``.mcap``.

    Keyword Args:
        metadata, attachments, overwrite: see :class:`~worldenv_trl.record.RolloutWriter`.
        exclude: entries that are not recorded, before and after the step; the name of a nest leaves out all in it.
        kinematics: adds ``predicted_state`` to step-level rollouts with ``kinematic_state`` and ``action``.
        action_map: of one camera, adds ``action_map``; drawing it costs much more than everything else that is
            recorded.
        worker: replaces the worker's name, also outside of worker processes.
        queue_size: env steps that may wait to be written.

    Raises:
        ValueError, FileExistsError: as :class:`~worldenv_trl.record.RolloutWriter`, at once; at the first step, if
            ``exclude`` names nothing.
        OSError: as there, from the first step on.

    Examples:
        >>> import tempfile
        >>> from torchrl.envs import TransformedEnv
        >>> from worldenv_trl.envs import TabletopEnv
        >>> from worldenv_trl.record import list_rollouts
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     base = TabletopEnv("starter/open_the_top_drawer", 2, seed=0)
        ...     env = TransformedEnv(base, Recorder(f"{folder}/demo.mcap"))
        ...     rollout = env.rollout(5)
        ...     env.close()
        ...     [info.length for info in list_rollouts(f"{folder}/demo.mcap")]
        [5, 5]
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        metadata: Mapping[str, Any] | None = None,
        attachments: Mapping[str, bytes | str | os.PathLike] | None = None,
        overwrite: bool = False,
        exclude: Sequence[str | _Path] = (),
        kinematics: ForwardKinematics | None = None,
        action_map: ActionMap | None = None,
        worker: str | None = None,
        queue_size: int = 64,
    ) -> None:
        super().__init__()
        if not isinstance(queue_size, int) or queue_size < 1:
            raise ValueError(f"queue_size must be a whole number of at least 1, got {queue_size!r}")
        if isinstance(exclude, str) or not all(isinstance(key, str | tuple) for key in exclude):
            raise TypeError(
                f'exclude must be a list of entries, such as ["sim_state", ("next", "reward")], got {exclude!r}'
            )
        for name, part, kind in (
            ("kinematics", kinematics, "ForwardKinematics"),
            ("action_map", action_map, "ActionMap"),
        ):
            if part is not None and not callable(part):
                raise TypeError(f"{name} must be a worldenv_trl.kinematics.{kind}, got {part!r}")
        self._target = Path(path)
        self._options = {"metadata": metadata, "attachments": attachments, "overwrite": overwrite}
        self._derived: dict[str, Any] = {"kinematics": kinematics, "action_map": action_map}
        paths = [(key,) if isinstance(key, str) else key for key in exclude]
        self._exclude = [path[1:] if path[0] == "next" and len(path) > 1 else path for path in paths]
        self._worker, self._queue_size = worker, queue_size
        self._forget()
        check_target(self.path, overwrite)  # now, not after the first rollout

    def _forget(self) -> None:
        self._stream: RolloutStream | None = None
        self._fresh: Tensor | None = None  # bool [rows]: a rollout begins with the next step
        self._last: dict[_Path, tuple[Tensor, Tensor]] = {}  # what each chained entry was, and its copy of active rows
        self._paths: tuple[list[_Path], ...] | None = None  # root, next and chained entries, texts

    def __getstate__(self) -> dict[str, Any]:
        state = dict(super().__getstate__())
        if state.get("_stream") is not None:
            raise RuntimeError("a Recorder that is recording cannot be copied or sent to a process: make a new one")
        return state

    @property
    def path(self) -> Path:
        """Where this process records to."""
        worker = self._worker
        if worker is None and multiprocessing.parent_process() is not None:
            worker = multiprocessing.current_process().name
        if worker is None:
            return self._target
        return self._target.with_name(f"{self._target.stem}_{re.sub(r'[^A-Za-z0-9_-]', '_', worker)}.mcap")

    @property
    def rollouts(self) -> list[int]:
        """The numbers, in the file, of the rollouts that the rows ran last: what :meth:`annotate` needs."""
        return [] if self._stream is None else self._numbers.tolist()

    # ------------------------------------------------------------------------------------------------- recording

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        count = self.parent.batch_size.numel()
        if mask is None or self._fresh is None:
            self._fresh, self._over = torch.ones(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
        else:
            self._fresh |= mask.reshape(-1).cpu()
            self._over &= ~mask.reshape(-1).cpu()
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._stream is None:
            self._open(tensordict, next_tensordict)
        active = tensordict.get("_step", None)
        active = ~self._over if active is None else active.reshape(-1).cpu() & ~self._over
        rows = active.nonzero().squeeze(-1)
        if not len(rows):
            return next_tensordict
        assert self._stream is not None and self._paths is not None and self._fresh is not None  # it is open
        roots, nexts, chained, texts = self._paths
        batch = len(self.parent.batch_size)
        everyone = len(rows) == len(active)
        fresh = self._fresh[rows]
        self._check_continuity(tensordict, rows[~fresh])
        values: dict[_Path, Tensor] = {}
        for source, paths, prefix in ((tensordict, roots, ()), (next_tensordict, nexts, ("next",))):
            for path in paths:
                value = _rows_of(source, path, batch, prefix)
                # A copy: the env may reuse its memory while the value waits to be written.
                values[*prefix, *path] = value.clone() if everyone else value[rows]
        self._last = {path: (next_tensordict.get(path), values["next", *path]) for path in chained}
        self._place[rows] = torch.arange(len(rows))
        begun: dict[_Path, Tensor] = {}
        said = None
        if bool(fresh.any()):
            beginning = rows[fresh]
            self._numbers[beginning] = torch.arange(self._begun, self._begun + len(beginning))
            self._begun += len(beginning)
            self._episode[beginning] += 1
            self._count[beginning] = 0
            sources = ((tensordict, ()), (next_tensordict, ("next",)))
            said = self._said(sources, texts, beginning)
            begun = {path: _rows_of(tensordict, path, batch)[beginning] for path in chained}
        values[(ROW,)], values[(EPISODE,)] = rows.unsqueeze(-1), self._episode[rows].unsqueeze(-1)
        self._stream.put(values, begun, self._numbers[rows], self._count[rows], fresh, said)
        self._count[rows] += 1
        self._fresh[rows] = False
        done = next_tensordict.get("done", None)
        if done is not None:
            self._over[rows] = done.reshape(-1).cpu()[rows]
        return next_tensordict

    def _open(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        container = self.__dict__["_container"]()
        if isinstance(container, Compose) and any(isinstance(t, MultiAction) for t in container.transforms):
            raise ValueError("a chunked env must not be unwrapped: record it with recorded(env, path)")
        count = self.parent.batch_size.numel()
        if self._fresh is None:
            self._fresh, self._over = torch.ones(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
        roots, root_texts = leaves(_entries(tensordict))
        nexts, next_texts = leaves(_entries(next_tensordict))
        known = {*roots, *root_texts, *nexts, *next_texts}
        for left_out in self._exclude:
            if not any(path[: len(left_out)] == left_out for path in known):
                close = difflib.get_close_matches("/".join(left_out), ["/".join(path) for path in known], n=3)
                hint = (
                    f"did you mean {' or '.join(close)}"
                    if close
                    else f"it has {', '.join(sorted(map('/'.join, known)))}"
                )
                raise ValueError(f"exclude names {'/'.join(left_out)}, which the env does not show: {hint}?")
        keep = lambda paths: [p for p in paths if not any(p[: len(out)] == out for out in self._exclude)]  # noqa: E731
        texts = keep(root_texts) + [("next", *path) for path in keep(next_texts)]
        # Stored once: what was seen after a step is what is seen before the next one.
        chained = [
            path
            for path in keep(roots)
            if path in nexts and (roots[path].dtype, roots[path].shape) == (nexts[path].dtype, nexts[path].shape)
        ]
        self._paths = [path for path in keep(roots) if path not in chained], keep(nexts), chained, texts
        self._place = torch.zeros(count, dtype=torch.int64)
        self._numbers, self._count = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.int64)
        self._episode, self._begun = torch.full((count,), -1), 0
        base = _innermost(self.parent)
        limits = getattr(base, "_limit", getattr(base, "max_steps", None))  # of each row, of all, or unknown
        if limits is not None:
            limits = torch.as_tensor(limits, dtype=torch.int64).flatten().expand(count).clone()
        slot = _DEFAULT_STEPS if limits is None else int(limits.max())
        self._stream = RolloutStream(
            self.path,
            self._options,
            texts,
            rows=count,
            slot_steps=slot,
            limits=limits,
            queue_size=self._queue_size,
            proprio=getattr(base, "proprio", "measured"),
            **self._derived,
        )

    def _check_continuity(self, tensordict: TensorDictBase, rows: Tensor) -> None:
        """What the env showed after the last step of ``rows`` must be what it shows now."""
        for path, (shown, copy) in self._last.items() if len(rows) else ():
            if tensordict.get(path, None) is shown:
                continue
            now = _rows_of(tensordict, path, len(self.parent.batch_size))[rows]
            same = (to_bytes(now) == to_bytes(copy[self._place[rows]])).all(-1)
            if not same.all():
                raise ValueError(
                    f"entry {path} changed between two steps of row {int(rows[int((~same).argmax())])}: the Recorder "
                    "must be the outermost transform and nothing may change observations behind it, or exclude it"
                )

    def _said(self, sources: Sequence, texts: list[_Path], rows: Tensor) -> list[tuple[str, ...]]:
        """The texts of rows that begin, in the order of ``texts``."""
        columns = []
        for path in texts:
            source, below = (sources[1][0], path[1:]) if path[0] == "next" else (sources[0][0], path)
            value = source.get(below)
            words = value if isinstance(value, str) else value.tolist()
            while isinstance(words, list) and words and isinstance(words[0], list):
                words = [word for part in words for word in part]
            words = [words] * len(self._over) if isinstance(words, str) else words
            columns.append([words[row] for row in rows.tolist()])
        return list(zip(*columns, strict=True)) if columns else [()] * len(rows)

    # ------------------------------------------------------------------------------------------------- later

    def annotate(self, entries: TensorDictBase, rollouts: Sequence[int] | None = None) -> None:
        """Adds what became known later, see :meth:`RolloutWriter.annotate`; by default to :attr:`rollouts`.

        Raises:
            RuntimeError: before the first step.
        """
        if self._stream is None:
            raise RuntimeError("there is nothing to annotate: no step was recorded")
        self._stream.annotate(entries, self.rollouts if rollouts is None else rollouts)

    def flush(self) -> None:
        """Waits until everything recorded is in the hands of the operating system."""
        if self._stream is not None:
            self._stream.flush()

    def close(self) -> None:
        """Finishes the file; closing the env does. A later step begins a new file."""
        stream = self._stream
        self._forget()
        if stream is not None:
            stream.close()


def recorded(env: EnvBase, path: str | os.PathLike, **options: Any) -> TransformedEnv:
    """``env`` with a :class:`Recorder` around it; also right for chunked and imagined envs."""
    return TransformedEnv(env, Recorder(path, **options), auto_unwrap=False)


def _entries(tensordict: TensorDictBase) -> TensorDictBase:
    names = [name for name in tensordict.keys() if not name.startswith("_") and name != "next"]  # noqa: SIM118
    return tensordict.select(*names)


def _rows_of(source: TensorDictBase, path: _Path, batch: int, prefix: _Path = ()) -> Tensor:
    """An entry [*B, ...] as [rows, ...]."""
    value = source.get(path, None)
    if value is None:
        raise ValueError(f"entry {(*prefix, *path)} is missing, it was there when recording began")
    return value.detach().cpu().flatten(0, batch - 1) if batch > 1 else value.detach().cpu()


def _innermost(env: EnvBase) -> EnvBase:
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env

"""Training one part in all processes: ``DistributedDataParallel`` for small parts, ``fully_shard`` (FSDP2) for large.

Every process learns from its rows of the same batch; what they step with is the gradient of the whole batch. In one
process it is the loss, its backward pass and nothing else.
"""

from __future__ import annotations

import copy
import gc
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor
from torch.nn.parallel import DistributedDataParallel

import processes
from worldenv_trl.devices import device_of

MODES = ("ddp", "fsdp")
_UNIT = 2**20  # parameters that learn, from which a layer of a list is gathered and freed by itself

Loss = Callable[[TensorDictBase], TensorDictBase]


class DataParallel:
    """A part that is trained on batches of which every process holds some rows.

    With ``fsdp`` a copy of what learns is sharded and trained: ``part`` itself stays whole, for acting, and follows at
    every :meth:`state_dict` and :meth:`gather`. What is frozen is not copied, nor sharded, nor moved: acting needs it
    whole in every process.

    Args:
        part: what is trained; the same weights in every process.
        make_loss: from the part, or its sharded copy, to the loss that trains it.
        mode: of :data:`MODES`; without meaning in one process.

    Attributes:
        part: see above.
    """

    def __init__(self, part: nn.Module, make_loss: Callable[[Any], Loss], mode: str = "ddp") -> None:
        self.part, self._trained, self._size = part, part, processes.size()
        self._call: Callable[[TensorDictBase], Any]
        if self._size == 1:
            self._call = make_loss(part)
        elif mode == "ddp":
            objective = _Objective(part, make_loss)
            # A loss may leave parameters out, and which ones may change; torch looks for them, and complains of the
            # search where all take part. One that no loss knows is always found.
            objective.idle = nn.Parameter(torch.zeros((), device=device_of(part)))
            self._call = DistributedDataParallel(objective, forward_sync_buffers=False, find_unused_parameters=True)
        else:
            frozen = [parameter for parameter in part.parameters() if not parameter.requires_grad]
            self._trained = copy.deepcopy(part, {id(parameter): parameter for parameter in frozen})
            for parameter in self._trained.parameters():
                if parameter.requires_grad:
                    parameter.data = parameter.data.contiguous()  # channels last cannot be shared
            self._call = _sharded(_Objective(self._trained, make_loss))

    def __call__(self, batch: TensorDictBase) -> Any:
        """What the loss makes of this process's rows."""
        return self._call(batch)

    def trained(self, parameters: Iterable[nn.Parameter]) -> list[nn.Parameter]:
        """The parameters that are trained in place of those of the part."""
        if self._trained is self.part:
            return list(parameters)
        names = {parameter: name for name, parameter in self.part.named_parameters()}
        mine = dict(self._trained.named_parameters())
        return [mine[names[parameter]] for parameter in parameters]

    def on_exchange(self, hook: Callable[[Any, Any], Any]) -> None:
        """Lets a communication hook of ``torch.distributed.algorithms`` exchange the gradients, of ``ddp`` alone."""
        if isinstance(self._call, DistributedDataParallel):
            self._call.register_comm_hook(None, hook)

    # ------------------------------------------------------------------------------------------------- backward

    def backward_mean(self, value: Tensor, weight: Tensor | float) -> Tensor:
        """Gradients of a mean over the whole batch; returns that mean.

        Args:
            value: scalar, the mean over this process's rows.
            weight: what they weigh in it.

        Raises:
            ValueError: for a mean that is not finite, before anything is learned from it.
        """
        if self._size == 1:
            _check_finite(value)
            value.backward()
            return value.detach()
        weight = torch.as_tensor(weight, dtype=value.dtype, device=value.device)
        weighted, weights = processes.total(torch.stack([value.detach() * weight, weight])).unbind()
        mean = weighted / weights.clamp_min(1e-12)
        _check_finite(mean)
        self._backward(value * (weight / weights.clamp_min(1e-12)))
        return mean

    def backward_sum(self, value: Tensor) -> None:
        """Gradients of the sum of what all processes give; raises as :meth:`backward_mean`, of what this one gives."""
        _check_finite(value)
        if self._size == 1:
            value.backward()
        else:
            self._backward(value)

    def _backward(self, value: Tensor) -> None:
        (value * self._size).backward()  # both kinds divide the sum of the gradients by the number of processes
        if self._trained is not self.part:
            for parameter in _scalars(self._trained):
                if parameter.grad is not None:
                    parameter.grad = processes.total(parameter.grad) / self._size

    @contextmanager
    def accumulating(self, last: bool) -> Iterator[None]:
        """Around forward and backward of a part of the batch: gradients are exchanged after the last one."""
        if last or not isinstance(self._call, DistributedDataParallel):
            yield
        else:
            with self._call.no_sync():
                yield

    # ------------------------------------------------------------------------------------------------- whole weights

    @torch.no_grad()
    def gather(self) -> None:
        """Lets the whole part follow the shards."""
        if self._trained is not self.part:
            whole = dict(self.part.named_parameters())
            for name, parameter in self._trained.named_parameters():
                if parameter.requires_grad:
                    whole[name].copy_(_full(parameter))

    @torch.no_grad()
    def scatter(self) -> None:
        """Lets the shards follow the whole part."""
        if self._trained is not self.part:
            mine = dict(self._trained.named_parameters())
            for name, parameter in self.part.named_parameters():
                if mine[name] is not parameter:
                    mine[name].copy_(_like(parameter.detach(), mine[name]))

    def state_dict(self) -> dict[str, Any]:
        """The part's, whole; to be asked for in all processes."""
        self.gather()
        return self.part.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        self.part.load_state_dict(state_dict)
        self.scatter()

    def close(self) -> None:
        """Ends the training: the part has the weights reached, and its gradients are its own again."""
        self.gather()
        self._call, self._trained = _nothing, self.part
        gc.collect()  # DistributedDataParallel refers to itself, and listens to the parameters until it is gone


class WholeOptimizer:
    """The state of an optimiser, of shards or not, as that of one of whole parameters."""

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self.optimizer = optimizer

    def state_dict(self) -> dict[str, Any]:
        """To be asked for in all processes."""
        state = self.optimizer.state_dict()
        moments = {
            index: {name: _full(value) for name, value in each.items()} for index, each in state["state"].items()
        }
        return state | {"state": moments}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        parameters = [parameter for group in self.optimizer.param_groups for parameter in group["params"]]
        moments = {
            index: {
                name: _like(value, parameters[int(index)]) if getattr(value, "ndim", 0) else value
                for name, value in each.items()
            }
            for index, each in state_dict["state"].items()
        }
        self.optimizer.load_state_dict(state_dict | {"state": moments})


def _check_finite(loss: Tensor) -> None:
    # A backward pass through infinities can end the process without a word.
    if not bool(loss.isfinite()):
        raise ValueError(
            f"the loss is {loss.item()}: lower the stage's learning rate, or look for NaN in the part and its data; "
            "another --run-dir with --begin-from this one takes over the stages before"
        )


def _nothing(batch: TensorDictBase) -> TensorDictBase:
    raise RuntimeError("the training has ended: make another DataParallel")


class _Objective(nn.Module):
    """A loss as a module whose only parameters are the part's, once, and whose outputs show their tensors."""

    def __init__(self, part: nn.Module, make_loss: Callable[[Any], Loss]) -> None:
        super().__init__()
        self.part, self._make_loss = part, make_loss
        self._loss: tuple[Loss, ...] = ()  # no submodule

    def forward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        if not self._loss:  # a functional loss keeps the parameters that it finds: whole ones, which FSDP lends here
            self._loss = (self._make_loss(self.part),)
        return dict(self._loss[0](batch).items())


def _sharded(objective: _Objective) -> _Objective:
    """Lets each process hold a share of what learns; scalars, which cannot be shared, whole."""
    mesh = init_device_mesh(device_of(objective).type, (processes.size(),))
    frozen = {parameter for parameter in objective.parameters() if not parameter.requires_grad}
    options: dict[str, Any] = {"mesh": mesh, "ignored_params": {*_scalars(objective), *frozen}}
    for module in reversed(list(objective.modules())):  # the inner ones first
        for layer in module if isinstance(module, nn.ModuleList) else ():
            called = not isinstance(layer, nn.ModuleList | nn.ModuleDict)
            learns = sum(parameter.numel() for parameter in layer.parameters() if parameter.requires_grad)
            if called and learns >= _UNIT:
                fully_shard(layer, **options)
    fully_shard(objective, **options)
    return objective


def _scalars(part: nn.Module) -> list[nn.Parameter]:
    return [parameter for name, parameter in sorted(part.named_parameters()) if parameter.ndim == 0]


def _full(value: Any) -> Any:
    return value.full_tensor() if isinstance(value, DTensor) else value


def _like(value: Tensor, parameter: Tensor) -> Tensor:
    if not isinstance(parameter, DTensor):
        return value
    return distribute_tensor(value.to(parameter.device), parameter.device_mesh, parameter.placements)

"""Adam over named parameters of a model whose rows (primitives) are added and removed during training."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from splatwizard_core.errors import ShapeError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_native import AdamUpdate, adam_steps

if TYPE_CHECKING:
    from splatwizard_core.rendering.rasterizer import RenderResult


@dataclass
class ParamGroup:
    """Parameters that share a learning rate.

    name    attribute path of a parameter or of a submodule of the model ("means", "mlp", "mlp.0.weight")
    lr      learning rate
    eps     of Adam; 1e-15 as in 3DGS
    betas   of Adam
    """

    name: str
    lr: float
    eps: float = 1e-15
    betas: tuple[float, float] = (0.9, 0.999)


@dataclass
class AdamState:
    """Adam's state of one parameter.

    step        updates so far
    tensors     "exp_avg" and "exp_avg_sq", of the parameter's shape; a subclass of the optimizer may keep more that
                have a row for each row of the parameter
    """

    step: int
    tensors: dict[str, Tensor]


class SplatOptimizer:
    """Adam without weight decay; parameters are found by name at every step, so a model may replace its tensors.

    A parameter without `.grad` is skipped: its moments and its step counter stay. So what a task has just
    replaced (densify, prune, opacity reset) is not updated in that step, as in the published trainer.

    groups      name -> ParamGroup
    states      parameter name -> AdamState, from its first update on
    """

    def __init__(self, model: SplatModel, groups: Iterable[ParamGroup]) -> None:
        """Raises ValueError for a group that names nothing, or a parameter that two groups claim."""
        self.model = model
        self.groups = {group.name: group for group in groups}
        self.states: dict[str, AdamState] = {}
        self._group_of: dict[str, str] = {}  # parameter name -> name of its group
        known = [name for name, _ in model.named_parameters()]
        for name in self.groups:
            members = [k for k in known if k == name or k.startswith(f"{name}.")]
            if not members:
                raise ValueError(f"{type(model).__name__} has no parameter or submodule with parameters '{name}'")
            for member in members:
                if member in self._group_of:
                    raise ValueError(f"parameter '{member}' is in the groups '{self._group_of[member]}' and '{name}'")
                self._group_of[member] = name

    def lr(self, name: str) -> float:
        """Return the current learning rate of a group."""
        return self.groups[name].lr

    def set_lr(self, name: str, lr: float) -> None:
        """Set the learning rate of a group from the next `step` on."""
        self.groups[name].lr = lr

    def step(self, result: RenderResult | None = None) -> None:
        """Update every parameter that has a gradient.

        result  of the step's render, for an optimizer that updates only what it shows; this one updates all rows
        """
        self.update([update for _, update in self.due()])

    def due(self) -> Iterator[tuple[str, AdamUpdate]]:
        """Return parameters with a gradient by name, with their next update; counts the step as done."""
        for name, group_name in self._group_of.items():
            param = _parameter(self.model, name)
            if param.grad is None:
                continue
            state = self.states.get(name) or self.fresh_state(name, param)
            state.step += 1
            group, moments = self.groups[group_name], state.tensors
            yield name, AdamUpdate(
                param.data, param.grad, moments["exp_avg"], moments["exp_avg_sq"],
                lr=group.lr, beta1=group.betas[0], beta2=group.betas[1], eps=group.eps, step=state.step,
            )  # fmt: skip

    def fresh_state(self, name: str, param: Tensor) -> AdamState:
        """Give a parameter zero moments and return its state; as in torch.optim.Adam there are none before."""
        self.states[name] = AdamState(0, {"exp_avg": _zeros(param), "exp_avg_sq": _zeros(param)})
        return self.states[name]

    def update(self, updates: Sequence[AdamUpdate]) -> None:
        """Apply these updates to all rows."""
        adam_steps(updates)

    def zero_grad(self) -> None:
        """Drop the gradients of all parameters of the model, those in no group included."""
        for module in self.model.modules():
            for param in module._parameters.values():
                if param is not None:
                    param.grad = None

    @torch.no_grad()
    def append_rows(self, model: SplatModel, rows: Mapping[str, Tensor]) -> None:
        """Add primitives at the end.

        model   the optimizer's model, or a submodule of it that is a SplatModel
        rows    attribute of `model.ROWS` -> new rows [n, ...]; every parameter must be there, buffers that are
                not get zeros

        New rows get zero moments; step counters stay. Raises ShapeError if rows do not fit.
        """
        count = self._check_new(model, rows)

        def longer(tensor: Tensor, new: Tensor | None = None) -> Tensor:
            added = tensor.new_zeros(count, *tensor.shape[1:]) if new is None else new.detach().to(tensor)
            return torch.cat([tensor, added])

        for name in model.ROWS:
            self._put(model, name, longer(attrgetter(name)(model).detach(), rows.get(name)), longer)

    def _check_new(self, model: SplatModel, rows: Mapping[str, Tensor]) -> int:
        """Return how many rows are new. Raises ShapeError."""
        _check_rows(model, rows, "append_rows")
        for name in model.ROWS:
            if name not in rows and isinstance(attrgetter(name)(model), nn.Parameter):
                raise ShapeError(f"append_rows: new rows of parameter '{name}' are missing")
        counts = {len(new) for new in rows.values()}
        if len(counts) != 1:
            raise ShapeError(f"append_rows: all rows need one count, got {sorted(counts)}")
        return counts.pop()

    @torch.no_grad()
    def keep_rows(self, model: SplatModel, mask: Tensor, *, carry_grad: bool = False) -> None:
        """Remove the primitives where `mask` [N] bool is False; moments follow, step counters stay.

        mask        or [M] int64, the rows that stay, each once, in the order that they are to have
        carry_grad  keep the survivors' gradient rows, so that they are updated in this step (Trimming the Fat)
        """
        ordered = mask.dtype == torch.int64
        if not ordered and (mask.dtype != torch.bool or mask.shape != (model.num_rows,)):
            raise ShapeError(f"keep_rows needs a bool mask [{model.num_rows}], got {mask.dtype} {list(mask.shape)}")
        index = mask if ordered else mask.nonzero().squeeze(1)
        everything = not ordered and index.numel() == mask.numel()

        def kept(tensor: Tensor) -> Tensor:
            return tensor if everything else tensor.index_select(0, index)

        for name in model.ROWS:
            old = attrgetter(name)(model)
            self._put(model, name, kept(old.detach()), kept)
            if carry_grad and isinstance(old, nn.Parameter) and old.grad is not None:
                attrgetter(name)(model).grad = kept(old.grad)

    @torch.no_grad()
    def set_rows(
        self, model: SplatModel, index: Tensor, rows: Mapping[str, Tensor], *, forget: Tensor | None = None
    ) -> None:
        """Give some primitives new values.

        index   [n] int64, each row once
        rows    parameter or buffer of `model.ROWS` -> new rows [n, ...]; what is not named keeps its values
        forget  [m] int64, rows whose moments become zero in every parameter, named or not; None: those of `index`

        Step counters stay. Every parameter of the model is a new tensor afterwards: none is updated in this step.
        Raises ShapeError if rows do not fit.
        """
        forget = index if forget is None else forget
        _check_rows(model, rows, "set_rows", len(index))
        for name in model.ROWS:
            new = attrgetter(name)(model).detach()
            if name in rows:
                new = new.index_copy(0, index, rows[name].detach().to(new))
            self._put(model, name, new, lambda t: t.index_fill(0, forget, 0))

    @torch.no_grad()
    def replace(self, model: SplatModel, name: str, tensor: Tensor) -> None:
        """Give one parameter (or buffer) a new value; its moments become zero, its step counter stays."""
        fresh = self._put(model, name, tensor.detach().to(attrgetter(name)(model)))
        state = self.states.get(self._prefix(model) + name)
        if state is not None:
            state.tensors = {"exp_avg": _zeros(fresh), "exp_avg_sq": _zeros(fresh)}

    def moments(self, name: str) -> tuple[Tensor, Tensor, int] | None:
        """Return (exp_avg, exp_avg_sq, step) of a parameter by its full name; None before its first update."""
        state = self.states.get(name)
        return None if state is None else (state.tensors["exp_avg"], state.tensors["exp_avg_sq"], state.step)

    def state_dict(self) -> dict[str, Any]:
        """{"groups": {name: {lr, eps, betas}}, "moments": {parameter: {exp_avg, exp_avg_sq, step}}}; no copies."""
        return {
            "groups": {n: {"lr": g.lr, "eps": g.eps, "betas": list(g.betas)} for n, g in self.groups.items()},
            "moments": {name: {**state.tensors, "step": state.step} for name, state in self.states.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Inverse of `state_dict`; the model must have its parameters already.

        Raises ValueError if the groups differ or a moment does not fit its parameter.
        """
        if set(state["groups"]) != set(self.groups):
            raise ValueError(f"optimizer groups differ: {', '.join(state['groups'])} / {', '.join(self.groups)}")
        loaded = {}
        for name, saved in state["moments"].items():
            if name not in self._group_of:
                raise ValueError(f"optimizer state of '{name}', which is in no group")
            param = self.model.get_parameter(name)
            tensors = {key: value for key, value in saved.items() if key != "step"}
            for moment in (tensors["exp_avg"], tensors["exp_avg_sq"]):
                if moment.shape != param.shape:
                    raise ValueError(f"optimizer state of '{name}' is {list(moment.shape)}, not {list(param.shape)}")
            # Copies: what is loaded must not be changed in place.
            loaded[name] = AdamState(int(saved["step"]), {k: t.to(param.device, copy=True) for k, t in tensors.items()})
        for name, g in state["groups"].items():
            first, second = g["betas"]
            self.groups[name] = ParamGroup(name, float(g["lr"]), float(g["eps"]), (float(first), float(second)))
        self.states = loaded

    def _prefix(self, model: SplatModel) -> str:
        """Return the name prefix of `model` in the optimizer's model: "" for itself, "inner." for a submodule."""
        for path, module in self.model.named_modules():
            if module is model:
                return f"{path}." if path else ""
        raise ValueError(f"this {type(model).__name__} is not part of the model that is being optimised")

    def _put(
        self, model: SplatModel, name: str, tensor: Tensor, change: Callable[[Tensor], Tensor] | None = None
    ) -> Tensor:
        """Set an attribute and return it; a parameter becomes a new one without gradient, so this step skips it.

        change  of what the state of the parameter holds
        """
        state = self.states.get(self._prefix(model) + name)
        owner_name, _, leaf = name.rpartition(".")
        owner = model.get_submodule(owner_name)
        old = getattr(owner, leaf)
        if isinstance(old, nn.Parameter):
            tensor = nn.Parameter(tensor, requires_grad=old.requires_grad)
        setattr(owner, leaf, tensor)
        if state is not None and change is not None:
            state.tensors = {key: change(each) for key, each in state.tensors.items()}
        return tensor


def _check_rows(model: SplatModel, rows: Mapping[str, Tensor], doing: str, count: int | None = None) -> None:
    """Raise ShapeError unless all are rows of the model, `count` of each if that is given."""
    for name, new in rows.items():
        if name not in model.ROWS:
            raise ShapeError(f"{doing}: '{name}' is not among the rows of {type(model).__name__}")
        row = attrgetter(name)(model).shape[1:]
        if new.shape[1:] != row or new.dim() == 0 or count not in (None, len(new)):
            expected = ("n" if count is None else count, *row)
            wanted = ", ".join(map(str, expected))
            raise ShapeError(f"{doing}: '{name}' must be [{wanted}], got {list(new.shape)}")


def _parameter(model: SplatModel, name: str) -> nn.Parameter:
    # Asked for at every step, of networks a name a layer: torch's own way looks for each attribute several times.
    *path, leaf = name.split(".")
    owner: Any = model
    for part in path:
        owner = owner._modules[part]
    found: nn.Parameter = owner._parameters[leaf]
    return found


def _zeros(param: Tensor) -> Tensor:
    return torch.zeros_like(param, memory_format=torch.contiguous_format, requires_grad=False)

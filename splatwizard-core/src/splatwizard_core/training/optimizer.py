"""One Adam over named parameters of a model, whose rows may come and go while it trains."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from splatwizard_core.errors import ShapeError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.training.learning_rate import exponential_lr
from splatwizard_core.training.sparse_adam import BiasCorrection

__all__ = ["ParamGroup", "SplatOptimizer", "exponential_lr"]


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
class _Moments:
    exp_avg: Tensor
    exp_avg_sq: Tensor
    step: int = 0
    row_steps: Tensor | None = None  # [N] int32 updates of each row, for sparse steps with bias correction


class SplatOptimizer:
    """Adam without weight decay; parameters are found by name at every step, so a model may replace its tensors.

    A parameter without `.grad` is skipped: its moments and its step counter stay. So what a task has just
    replaced (densify, prune, opacity reset) is not updated in that step, as in the published trainer.
    """

    def __init__(
        self, model: SplatModel, groups: Iterable[ParamGroup], *, sparse: BiasCorrection | None = None
    ) -> None:
        """Raises ValueError for a group that names nothing, or a parameter that two groups claim.

        sparse  update only the rows that `step` is told of (`sparse_adam`), with this bias correction; None: dense
        """
        self.model = model
        self.sparse = sparse
        self.groups = {group.name: group for group in groups}
        self._members: dict[str, list[str]] = {}
        self._moments: dict[str, _Moments] = {}
        owner: dict[str, str] = {}
        known = [name for name, _ in model.named_parameters()]
        for name in self.groups:
            members = [k for k in known if k == name or k.startswith(f"{name}.")]
            if not members:
                raise ValueError(f"{type(model).__name__} has no parameter or submodule with parameters '{name}'")
            for member in members:
                if member in owner:
                    raise ValueError(f"parameter '{member}' is in the groups '{owner[member]}' and '{name}'")
                owner[member] = name
            self._members[name] = members

    def lr(self, name: str) -> float:
        """Current learning rate of a group."""
        return self.groups[name].lr

    def set_lr(self, name: str, lr: float) -> None:
        """Learning rate of a group from the next `step` on."""
        self.groups[name].lr = lr

    @torch.no_grad()
    def step(self, visible: Tensor | None = None) -> None:
        """One Adam update of every parameter that has a gradient.

        visible     [N] bool, with `sparse`: which rows of the model are updated (None: all of them). Parameters that
                    are not rows of the model (networks) are updated whole.

        Raises ShapeError if the mask does not fit, ValueError if the optimizer is a dense one.
        """
        from splatwizard_core.training.adam import AdamUpdate, adam_steps

        if visible is not None and self.sparse is None:
            raise ValueError("step(visible) needs an optimizer that was made with `sparse`")
        updates = []
        for group_name, group in self.groups.items():
            beta1, beta2 = group.betas
            for name in self._members[group_name]:
                param = _parameter(self.model, name)
                if param.grad is None:
                    continue
                moments = self._moments.get(name)
                if moments is None:
                    # As torch.optim.Adam: moments exist from the first update on.
                    moments = self._moments[name] = _Moments(_zeros(param), _zeros(param))
                moments.step += 1
                if self.sparse is not None and name in self.model.ROWS:
                    self._sparse_step(param, moments, group, visible)
                    continue
                updates.append(
                    AdamUpdate(
                        param.data,
                        param.grad,
                        moments.exp_avg,
                        moments.exp_avg_sq,
                        lr=group.lr,
                        beta1=beta1,
                        beta2=beta2,
                        eps=group.eps,
                        step=moments.step,
                    )
                )
        adam_steps(updates)

    def _sparse_step(self, param: Tensor, moments: _Moments, group: ParamGroup, visible: Tensor | None) -> None:
        from splatwizard_core.training.sparse_adam import sparse_adam

        assert param.grad is not None
        assert self.sparse is not None
        if visible is None:
            visible = torch.ones(len(param), dtype=torch.bool, device=param.device)
        if self.sparse == "per_row" and moments.row_steps is None:
            moments.row_steps = torch.zeros(len(param), dtype=torch.int32, device=param.device)
        beta1, beta2 = group.betas
        sparse_adam(
            param.data, param.grad, moments.exp_avg, moments.exp_avg_sq, visible,
            lr=group.lr, beta1=beta1, beta2=beta2, eps=group.eps,
            bias_correction=self.sparse, row_steps=moments.row_steps,
        )  # fmt: skip

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
        prefix = self._prefix(model)
        count = self._check_rows(model, rows)
        for name in model.ROWS:
            old = _attribute(model, name)
            new = rows.get(name)
            new = old.new_zeros(count, *old.shape[1:]) if new is None else new.detach().to(old)
            self._put(model, name, torch.cat([old.detach(), new]))
            moments = self._moments.get(prefix + name)
            if moments is not None:
                zeros = torch.zeros_like(new)
                moments.exp_avg = torch.cat([moments.exp_avg, zeros])
                moments.exp_avg_sq = torch.cat([moments.exp_avg_sq, zeros])
                if moments.row_steps is not None:
                    moments.row_steps = torch.cat([moments.row_steps, moments.row_steps.new_zeros(count)])

    def _check_rows(self, model: SplatModel, rows: Mapping[str, Tensor]) -> int:
        counts = set()
        for name in rows:
            if name not in model.ROWS:
                raise ShapeError(f"append_rows: '{name}' is not among the rows of {type(model).__name__}")
        for name in model.ROWS:
            old = _attribute(model, name)
            new = rows.get(name)
            if new is None:
                if isinstance(old, nn.Parameter):
                    raise ShapeError(f"append_rows: new rows of parameter '{name}' are missing")
                continue
            if new.shape[1:] != old.shape[1:] or new.dim() != old.dim():
                raise ShapeError(
                    f"append_rows: '{name}' must be [n, {', '.join(map(str, old.shape[1:]))}], got {list(new.shape)}",
                    actual=new.shape,
                    expected=("n", *old.shape[1:]),
                )
            counts.add(new.shape[0])
        if len(counts) != 1:
            raise ShapeError(f"append_rows: all rows need one count, got {sorted(counts)}")
        return counts.pop()

    @torch.no_grad()
    def keep_rows(self, model: SplatModel, mask: Tensor, *, carry_grad: bool = False) -> None:
        """Remove the primitives where `mask` [N] bool is False; moments follow, step counters stay.

        carry_grad  keep the survivors' gradient rows, so that they are updated in this step (Trimming the Fat)
        """
        if mask.dtype != torch.bool or mask.shape != (model.num_rows,):
            raise ShapeError(
                f"keep_rows needs a bool mask [{model.num_rows}], got {mask.dtype} {list(mask.shape)}",
                actual=mask.shape,
                expected=(model.num_rows,),
            )
        prefix = self._prefix(model)
        index = mask.nonzero().squeeze(1)
        everything = index.numel() == mask.numel()

        def kept(tensor: Tensor) -> Tensor:
            return tensor if everything else tensor.index_select(0, index)

        for name in model.ROWS:
            old = _attribute(model, name)
            grad = old.grad if carry_grad and isinstance(old, nn.Parameter) else None
            self._put(model, name, kept(old.detach()))
            if grad is not None:
                _attribute(model, name).grad = kept(grad)
            moments = self._moments.get(prefix + name)
            if moments is not None:
                moments.exp_avg, moments.exp_avg_sq = kept(moments.exp_avg), kept(moments.exp_avg_sq)
                if moments.row_steps is not None:
                    moments.row_steps = kept(moments.row_steps)

    @torch.no_grad()
    def set_rows(self, model: SplatModel, index: Tensor, rows: Mapping[str, Tensor]) -> None:
        """Give some primitives new values.

        index   [n] int64, each row once
        rows    parameter or buffer of `model.ROWS` -> new rows [n, ...]; what is not named keeps its values

        Moments of these rows become zero in every parameter, named or not; step counters stay. Every parameter of the
        model is a new tensor afterwards: none is updated in this step. Raises ShapeError if rows do not fit.
        """
        for name, new in rows.items():
            expected = (len(index), *_attribute(model, name).shape[1:]) if name in model.ROWS else None
            if expected is None or new.shape != expected:
                raise ShapeError(
                    f"set_rows: '{name}' must be one of the rows of {type(model).__name__} and "
                    f"{list(expected or ())}, got {list(new.shape)}",
                    actual=new.shape,
                    expected=expected,
                )
        prefix = self._prefix(model)
        for name in model.ROWS:
            old = _attribute(model, name)
            if name in rows:
                self._put(model, name, old.detach().index_copy(0, index, rows[name].detach().to(old)))
            elif isinstance(old, nn.Parameter):
                self._put(model, name, old.detach())
            moments = self._moments.get(prefix + name)
            if moments is not None:
                moments.exp_avg = moments.exp_avg.index_fill(0, index, 0)
                moments.exp_avg_sq = moments.exp_avg_sq.index_fill(0, index, 0)
                if moments.row_steps is not None:
                    moments.row_steps = moments.row_steps.index_fill(0, index, 0)

    @torch.no_grad()
    def replace(self, model: SplatModel, name: str, tensor: Tensor) -> None:
        """Give one parameter (or buffer) a new value; its moments become zero, its step counter stays."""
        old = _attribute(model, name)
        self._put(model, name, tensor.detach().to(old))
        moments = self._moments.get(self._prefix(model) + name)
        if moments is not None:
            fresh = _attribute(model, name)
            moments.exp_avg, moments.exp_avg_sq = _zeros(fresh), _zeros(fresh)
            moments.row_steps = None  # its count is one of updates that the moments hold

    def moments(self, name: str) -> tuple[Tensor, Tensor, int] | None:
        """(exp_avg, exp_avg_sq, step) of a parameter by its full name; None before its first update."""
        found = self._moments.get(name)
        return None if found is None else (found.exp_avg, found.exp_avg_sq, found.step)

    def state_dict(self) -> dict[str, Any]:
        """{"groups": {name: {lr, eps, betas}}, "moments": {parameter: {exp_avg, exp_avg_sq, step}}}; no copies."""
        return {
            "groups": {n: {"lr": g.lr, "eps": g.eps, "betas": list(g.betas)} for n, g in self.groups.items()},
            "moments": {
                n: {"exp_avg": m.exp_avg, "exp_avg_sq": m.exp_avg_sq, "step": m.step}
                | ({} if m.row_steps is None else {"row_steps": m.row_steps})
                for n, m in self._moments.items()
            },
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Inverse of `state_dict`; the model must have its parameters already.

        Raises ValueError if the groups differ or a moment does not fit its parameter.
        """
        if set(state["groups"]) != set(self.groups):
            raise ValueError(f"optimizer groups differ: {', '.join(state['groups'])} / {', '.join(self.groups)}")
        members = {member for names in self._members.values() for member in names}
        loaded = {}
        for name, m in state["moments"].items():
            if name not in members:
                raise ValueError(f"optimizer state of '{name}', which is in no group")
            param = self.model.get_parameter(name)
            if m["exp_avg"].shape != param.shape or m["exp_avg_sq"].shape != param.shape:
                raise ValueError(f"optimizer state of '{name}' is {list(m['exp_avg'].shape)}, not {list(param.shape)}")
            # Clones: what is loaded must not be changed in place.
            loaded[name] = _Moments(m["exp_avg"].clone().to(param), m["exp_avg_sq"].clone().to(param), int(m["step"]))
            if "row_steps" in m:
                loaded[name].row_steps = m["row_steps"].clone().to(param.device, torch.int32)
        for name, g in state["groups"].items():
            betas = g["betas"]
            self.groups[name] = ParamGroup(name, float(g["lr"]), float(g["eps"]), (float(betas[0]), float(betas[1])))
        self._moments = loaded

    def _prefix(self, model: SplatModel) -> str:
        """Where `model` sits in the optimizer's model: "" for itself, "inner." for a submodule."""
        for path, module in self.model.named_modules():
            if module is model:
                return f"{path}." if path else ""
        raise ValueError(f"this {type(model).__name__} is not part of the model that is being optimised")

    @staticmethod
    def _put(model: SplatModel, name: str, tensor: Tensor) -> None:
        """Set an attribute; a parameter becomes a new one without gradient, so this step skips it."""
        owner_name, _, leaf = name.rpartition(".")
        owner = model.get_submodule(owner_name)
        old = getattr(owner, leaf)
        if isinstance(old, nn.Parameter):
            tensor = nn.Parameter(tensor, requires_grad=old.requires_grad)
        setattr(owner, leaf, tensor)


def _parameter(model: SplatModel, name: str) -> nn.Parameter:
    # Asked for at every step, of networks a name a layer: torch's own way looks for each attribute several times.
    *path, leaf = name.split(".")
    owner: Any = model
    for part in path:
        owner = owner._modules[part]
    found: nn.Parameter = owner._parameters[leaf]
    return found


def _attribute(model: SplatModel, name: str) -> Tensor:
    owner_name, _, leaf = name.rpartition(".")
    found: Tensor = getattr(model.get_submodule(owner_name), leaf)
    return found


def _zeros(param: Tensor) -> Tensor:
    return torch.zeros_like(param, memory_format=torch.contiguous_format, requires_grad=False)

"""Stage wrapper: reuse another method's training stage and override parts of it."""

from __future__ import annotations

import functools
from typing import Any

from splatwizard_core.api import OptimizationParams, Stage


class WrappedStage(Stage):
    """Forwards everything to the inner stage; subclasses override parts.

    inner   the stage inside
    opt     hyper-parameters that the tasks of both see; None: those of the stage inside
    """

    def __init__(self, inner: Stage, opt: OptimizationParams | None = None) -> None:
        super().__init__(inner.opt if opt is None else opt)
        self.inner = inner
        self.name = inner.name


def _of_inner(name: str, member: Any) -> Any:
    """Return a property or method of `Stage` as the stage inside has it."""
    if isinstance(member, property):
        return property(lambda stage: getattr(stage.inner, name), doc=member.__doc__)

    @functools.wraps(member)
    def method(stage: WrappedStage, *args: Any, **kwargs: Any) -> Any:
        return getattr(stage.inner, name)(*args, **kwargs)

    return method


for _name, _member in vars(Stage).items():
    # `when` scales by hyper-parameters of who asks, tasks are added to the outer one, steps made of what it overrides.
    if not _name.startswith("_") and _name not in ("name", "when", "added", "whole_step"):
        setattr(WrappedStage, _name, _of_inner(_name, _member))

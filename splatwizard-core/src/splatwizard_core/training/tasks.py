"""Arguments of schedule tasks, bound to their parameters by type annotation."""

from __future__ import annotations

import functools
import inspect
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from torch import nn

from splatwizard_core.base.values import members
from splatwizard_core.errors import TaskSignatureError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer, RenderResult
from splatwizard_core.scene.scene import Scene
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.optimizer import SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.stage import CameraIterator
from splatwizard_core.training.task_log import TaskLog


@dataclass
class TaskContext:
    """Values passed to tasks; an annotation selects the field.

    step        the current step, 1-based
    cameras     the task camera iterator, independent of the training sampler
    result, loss    of the current step; None before rendering
    scheduler   filled in by the scheduler that runs the task
    log         of the current step
    """

    ppl: PipelineParams
    opt: OptimizationParams
    model: SplatModel
    scene: Scene
    optimizer: SplatOptimizer
    cameras: CameraIterator
    rasterizer: Rasterizer
    step: int = 0
    result: RenderResult | None = None
    loss: LossPack | None = None
    scheduler: Any = None
    log: TaskLog = field(default_factory=TaskLog)


SOURCES: dict[type, str] = {
    RenderResult: "result",
    LossPack: "loss",
    PipelineParams: "ppl",
    OptimizationParams: "opt",
    SplatModel: "model",
    Scene: "scene",
    SplatOptimizer: "optimizer",
    CameraIterator: "cameras",
    Rasterizer: "rasterizer",
    TaskLog: "log",
}
"""Annotation class (or a subclass of it) -> field of TaskContext. The module of the scheduler adds that."""

EXACTLY: dict[type, str] = {int: "step", nn.Module: "model"}
"""Annotation classes that select a field, without their subclasses."""

POST_ONLY = ("result", "loss")


@dataclass(frozen=True)
class Argument:
    """Source of one parameter's value.

    field       of TaskContext
    classes     the value must be an instance of one of them
    keyword     passed by its name, not by position
    """

    parameter: str
    field: str
    classes: tuple[type, ...]
    keyword: bool


@dataclass(frozen=True)
class Binding:
    """A task with its arguments resolved once, at registration."""

    task: Callable[..., Any]
    name: str
    arguments: Sequence[Argument]

    def check(self, context: TaskContext, *, skip: Sequence[str] = ()) -> None:
        """Raise TaskSignatureError if the context holds something else than a parameter is annotated with."""
        for a in self.arguments:
            value = getattr(context, a.field)
            if a.field in skip or isinstance(value, a.classes):
                continue
            wanted = " | ".join(c.__name__ for c in a.classes)
            raise TaskSignatureError(
                f"task '{self.name}': parameter '{a.parameter}' wants {wanted}, this run has {type(value).__name__}"
            )

    def __call__(self, context: TaskContext) -> Any:
        self.check(context)
        positional = [getattr(context, a.field) for a in self.arguments if not a.keyword]
        named = {a.parameter: getattr(context, a.field) for a in self.arguments if a.keyword}
        return self.task(*positional, **named)


def bind(task: Callable[..., Any], stage: str, name: str) -> Binding:
    """Resolve where each parameter of `task` comes from.

    task    function, bound method, functools.partial or object with __call__; no decorator is needed
    stage   "pre" or "post": RenderResult and LossPack exist in post only

    Raises TaskSignatureError: a parameter that nothing can be supplied for, *args or **kwargs, or an
    annotation that cannot be resolved.
    """
    if inspect.isclass(task):
        raise TaskSignatureError(f"task '{name}' is the class {task.__name__} itself: register an instance of it")
    try:
        parameters = inspect.signature(task).parameters.values()
    except (TypeError, ValueError) as error:
        raise TaskSignatureError(f"task '{name}': its signature cannot be read ({error})") from error
    given = task.keywords if isinstance(task, functools.partial) else {}
    namespace = _namespace(task)
    arguments: list[Argument] = []
    by_keyword = False  # behind a parameter that keeps its default, the rest goes by name
    for p in parameters:
        if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD):
            stars = "*" if p.kind is p.VAR_POSITIONAL else "**"
            raise TaskSignatureError(
                f"task '{name}': {stars}{p.name} cannot be supplied; name and annotate the parameters"
            )
        classes = () if p.name in given else _classes(p, name, namespace)
        field = _field_of(classes)
        if field is None:
            if p.default is p.empty:
                raise TaskSignatureError(_unusable(p, name))
            by_keyword = True
            continue
        if field in POST_ONLY and stage != "post":
            raise TaskSignatureError(
                f"task '{name}': parameter '{p.name}' wants {classes[0].__name__}, which exists after rendering only; "
                "register the task in register_post_task"
            )
        if by_keyword and p.kind is p.POSITIONAL_ONLY:
            raise TaskSignatureError(f"task '{name}': '{p.name}' is positional-only behind a parameter left out")
        arguments.append(Argument(p.name, field, classes, by_keyword or p.kind is p.KEYWORD_ONLY))
    return Binding(task, name, arguments)


def _namespace(task: Callable[..., Any]) -> dict[str, Any]:
    """Return the globals in which string annotations are read."""
    function: Any = task.func if isinstance(task, functools.partial) else task
    if not hasattr(function, "__globals__"):
        function = type(function).__call__
    return dict(getattr(inspect.unwrap(function), "__globals__", {}))


def _classes(p: inspect.Parameter, name: str, namespace: dict[str, Any]) -> tuple[Any, ...]:
    """Return what the annotation of a parameter allows, Annotated, unions and TypeVars unwrapped."""

    def resolve(annotation: Any) -> Any:
        holder = types.SimpleNamespace(__annotations__={"it": annotation})
        try:
            return typing.get_type_hints(holder, globalns=namespace, include_extras=True)["it"]
        except NameError as error:
            raise TaskSignatureError(
                f"task '{name}': annotation {annotation!r} of parameter '{p.name}' cannot be resolved ({error}); "
                "import the name at run time, not under TYPE_CHECKING"
            ) from error
        except (TypeError, SyntaxError) as error:
            raise TaskSignatureError(
                f"task '{name}': annotation {annotation!r} of parameter '{p.name}' is not a type ({error})"
            ) from error

    def allowed(annotation: Any) -> Iterator[Any]:
        for member in members(annotation):
            if isinstance(member, TypeVar):
                for bound in member.__constraints__ or (member.__bound__,):
                    yield from allowed(resolve(bound))
            else:
                yield member

    return () if p.annotation is p.empty else tuple(allowed(resolve(p.annotation)))


def _field_of(classes: Sequence[Any]) -> str | None:
    """Return the one field that all the classes (but NoneType) select, or None."""
    fields: set[str | None] = set()
    for found in classes:
        # By the MRO, since a protocol with attributes (Rasterizer) refuses issubclass().
        bases = found.__mro__ if isinstance(found, type) else ()
        if found is not types.NoneType:
            fields.add(next((SOURCES[base] for base in bases if base in SOURCES), EXACTLY.get(found)))
    return fields.pop() if len(fields) == 1 else None


def _unusable(p: inspect.Parameter, name: str) -> str:
    known = ", ".join(["int (the step)", *(base.__name__ for base in SOURCES)])
    if p.annotation is p.empty:
        return f"task '{name}': parameter '{p.name}' has no annotation; annotate it with one of {known}"
    shown = p.annotation if isinstance(p.annotation, str) else getattr(p.annotation, "__name__", repr(p.annotation))
    return f"task '{name}': nothing can be supplied for parameter '{p.name}: {shown}'; possible are {known}"

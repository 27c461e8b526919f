"""What a schedule task may ask for, and how its parameters are bound to it: by their type annotations."""

from __future__ import annotations

import functools
import inspect
import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, Union

from torch import nn

from splatwizard_core.errors import TaskSignatureError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer, RenderResult
from splatwizard_core.scene.scene import Scene
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.optimizer import SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.stage import CameraIterator


@dataclass
class TaskContext:
    """Everything that tasks are given, by the field that an annotation selects.

    step        the current step, 1-based
    cameras     the task camera iterator, independent of the training sampler
    result, loss    of the current step; None before rendering
    scheduler   filled in by the scheduler that runs the task
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


SOURCES: tuple[tuple[type, str], ...] = (
    (RenderResult, "result"),
    (LossPack, "loss"),
    (PipelineParams, "ppl"),
    (OptimizationParams, "opt"),
    (SplatModel, "model"),
    (Scene, "scene"),
    (SplatOptimizer, "optimizer"),
    (CameraIterator, "cameras"),
    (Rasterizer, "rasterizer"),
)
"""Annotation class (or a subclass of it) -> field of TaskContext."""

SUPERCLASSES: dict[type, str] = {nn.Module: "model"}
"""Superclasses of a source that are clear enough to stand for it."""

POST_ONLY = ("result", "loss")


@dataclass(frozen=True)
class Argument:
    """Where one parameter's value comes from.

    field       of TaskContext
    classes     what the value must be an instance of
    optional    None is legal too
    keyword     passed by this name; None: by position
    """

    parameter: str
    field: str
    classes: tuple[type, ...]
    optional: bool
    keyword: str | None


class Binding:
    """A task with its arguments resolved once, at registration."""

    def __init__(self, task: Callable[..., Any], name: str, arguments: Sequence[Argument]) -> None:
        self.task, self.name, self.arguments = task, name, tuple(arguments)

    def check(self, context: TaskContext, *, skip: Sequence[str] = ()) -> None:
        """Raise TaskSignatureError if the context holds something else than a parameter is annotated with."""
        for a in self.arguments:
            value = getattr(context, a.field)
            if a.field in skip or isinstance(value, a.classes) or (value is None and a.optional):
                continue
            wanted = " | ".join(c.__name__ for c in a.classes)
            raise TaskSignatureError(
                f"task '{self.name}': parameter '{a.parameter}' wants {wanted}, this run has {type(value).__name__}"
            )

    def __call__(self, context: TaskContext) -> Any:
        self.check(context)
        positional = [getattr(context, a.field) for a in self.arguments if a.keyword is None]
        named = {a.keyword: getattr(context, a.field) for a in self.arguments if a.keyword is not None}
        return self.task(*positional, **named)


def bind(task: Callable[..., Any], stage: str, name: str, sources: Sequence[tuple[type, str]] = SOURCES) -> Binding:
    """Resolve where each parameter of `task` comes from.

    task    function, bound method, functools.partial or object with __call__; no decorator is needed
    stage   "pre" or "post": RenderResult and LossPack exist in post only

    Raises TaskSignatureError: a parameter that nothing can be supplied for, *args or **kwargs, or an
    annotation that cannot be resolved.
    """
    if inspect.isclass(task):
        raise TaskSignatureError(f"task '{name}' is the class {task.__name__} itself: register an instance of it")
    function, given, named = _unwrap_partial(task)
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError) as error:
        raise TaskSignatureError(f"task '{name}': its signature cannot be read ({error})") from error
    namespace = _namespace(function)
    arguments: list[Argument] = []
    by_keyword = False  # behind a parameter that keeps its default, the rest goes by name
    for position, p in enumerate(parameters):
        if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD):
            stars = "*" if p.kind is p.VAR_POSITIONAL else "**"
            raise TaskSignatureError(
                f"task '{name}': {stars}{p.name} cannot be supplied; name and annotate the parameters"
            )
        if position < given:
            continue
        if p.name in named:
            by_keyword = True
            continue
        source = _source(p, name, sources, namespace)
        if source is None:
            if p.default is p.empty:
                raise TaskSignatureError(_unusable(p, name, sources))
            by_keyword = True
            continue
        field, classes, optional = source
        if field in POST_ONLY and stage != "post":
            raise TaskSignatureError(
                f"task '{name}': parameter '{p.name}' wants {classes[0].__name__}, which exists after rendering only; "
                "register the task in register_post_task"
            )
        if by_keyword and p.kind is p.POSITIONAL_ONLY:
            raise TaskSignatureError(f"task '{name}': '{p.name}' is positional-only behind a parameter left out")
        keyword = p.name if by_keyword or p.kind is p.KEYWORD_ONLY else None
        arguments.append(Argument(p.name, field, classes, optional, keyword))
    return Binding(task, name, arguments)


def _unwrap_partial(task: Callable[..., Any]) -> tuple[Callable[..., Any], int, frozenset[str]]:
    """The function inside nested partials, how many positional arguments they supply, and which by name."""
    given, named = 0, set()
    while isinstance(task, functools.partial):
        given += len(task.args)
        named |= set(task.keywords)
        task = task.func
    return task, given, frozenset(named)


def _namespace(function: Callable[..., Any]) -> dict[str, Any]:
    """The globals in which string annotations are read."""
    target: Any = function
    if not hasattr(target, "__globals__") and not inspect.ismethod(target):
        target = getattr(type(target), "__call__", target)  # noqa: B004 (the function itself is wanted)
    target = inspect.unwrap(target)
    return dict(getattr(getattr(target, "__func__", target), "__globals__", {}))


def _source(
    p: inspect.Parameter, name: str, sources: Sequence[tuple[type, str]], namespace: dict[str, Any]
) -> tuple[str, tuple[type, ...], bool] | None:
    """(field, classes, whether None is legal), or None if the annotation selects nothing."""
    if p.annotation is p.empty:
        return None
    members, optional = _members(_resolve(p.annotation, p.name, name, namespace), p.name, name, namespace)
    fields = {_field(member, sources) for member in members}
    if len(fields) != 1 or None in fields:
        return None
    (field,) = fields
    assert field is not None
    return field, tuple(members), optional


def _resolve(annotation: Any, parameter: str, name: str, namespace: dict[str, Any]) -> Any:
    holder = types.SimpleNamespace(__annotations__={"it": annotation})
    try:
        return typing.get_type_hints(holder, globalns=namespace, include_extras=True)["it"]
    except NameError as error:
        raise TaskSignatureError(
            f"task '{name}': annotation {annotation!r} of parameter '{parameter}' cannot be resolved ({error}); "
            "import the name at run time, not under TYPE_CHECKING"
        ) from error
    except (TypeError, SyntaxError) as error:
        raise TaskSignatureError(
            f"task '{name}': annotation {annotation!r} of parameter '{parameter}' is not a type ({error})"
        ) from error


def _members(annotation: Any, parameter: str, name: str, namespace: dict[str, Any]) -> tuple[list[Any], bool]:
    """The classes that an annotation allows (Annotated, unions and TypeVar bounds unwrapped), and if None is one."""
    while typing.get_origin(annotation) is Annotated:
        annotation = typing.get_args(annotation)[0]
    if isinstance(annotation, TypeVar):
        bound = annotation.__bound__
        alternatives = list(annotation.__constraints__) or ([] if bound is None else [bound])
        resolved = [_resolve(a, parameter, name, namespace) for a in alternatives]
        parts = [_members(r, parameter, name, namespace) for r in resolved]
    elif typing.get_origin(annotation) in (Union, types.UnionType):
        parts = [_members(a, parameter, name, namespace) for a in typing.get_args(annotation)]
    elif annotation is type(None):
        return [], True
    else:
        return [annotation], False
    return [c for classes, _ in parts for c in classes], any(optional for _, optional in parts)


def _field(annotation: Any, sources: Sequence[tuple[type, str]]) -> str | None:
    if annotation is int:
        return "step"
    if not isinstance(annotation, type):
        return None
    for base, field in sources:
        # By the MRO, since a protocol with attributes (Rasterizer) refuses issubclass().
        if base in annotation.__mro__:
            return field
    return SUPERCLASSES.get(annotation)


def _unusable(p: inspect.Parameter, name: str, sources: Sequence[tuple[type, str]]) -> str:
    known = ", ".join(["int (the step)", *(base.__name__ for base, _ in sources)])
    if p.annotation is p.empty:
        return f"task '{name}': parameter '{p.name}' has no annotation; annotate it with one of {known}"
    shown = p.annotation if isinstance(p.annotation, str) else getattr(p.annotation, "__name__", repr(p.annotation))
    return f"task '{name}': nothing can be supplied for parameter '{p.name}: {shown}'; possible are {known}"

"""Checks of what entries stand for: it is there, it is made with its defaults, and it has the contract's signature."""

from __future__ import annotations

import importlib
import inspect
from typing import TYPE_CHECKING, Any

from splatwizard_core import api
from sw_kit.finding import BrokenContractError, NotCheckedError, hold

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry

CODERS: dict[str, type] = {
    "symbols": api.EntropyCoder,
    "positions": api.PositionCodec,
    "arrays": api.ArrayCoder,
    "gaussians": api.GaussianCodec,
    "vectors": api.VectorCoder,
}
CONTRACTS: dict[str, type] = {
    "rasterizer": api.Rasterizer,
    "pruner": api.Pruner,
    "quantizer": api.Quantizer,
    "entropy model": api.EntropyModel,
    "context model": api.ContextModel,
    "dataset": api.Dataset,
    "method": api.Method,
    "density control": api.DensityControl,
}
ARGUMENTS = {"metric": 2, "exporter": 2, "importer": 1, "check": 0, "download": 0}
"""Kinds that are plain functions -> how many positional arguments they are called with."""
MADE_WITH_SETTINGS = ("quantizer", "entropy model", "context model")
"""Kinds whose contract does not say how they are made: a method that uses one knows."""


def check_target(entry: Entry, plugins: PluginManager) -> str:
    """Hold the target of an entry to its contract: import it, make it with its defaults, compare signatures."""
    whose = f"{entry.kind} '{entry.name}'"
    target = entry.load()
    if entry.kind == "command":
        return _check_command(target, whose)
    if entry.kind == "metric" and hasattr(target, "prepare"):
        _takes(target.prepare, 1, f"{whose}: prepare")
        _takes(target.identity, 1, f"{whose}: identity")
        return "gets ready with prepare(setup)"
    if entry.kind == "metric" and entry.declared.get("over") in ("views", "model"):
        _takes(target, 1, whose)
        return "takes a subject"
    if entry.kind in ARGUMENTS:
        hold(callable(target), f"{whose} stands for a {type(target).__name__}", f"{entry.target} must be a function")
        _takes(target, ARGUMENTS[entry.kind], whose)
        return f"takes {ARGUMENTS[entry.kind]} arguments"
    contract = CODERS.get(str(entry.declared.get("codes"))) if entry.kind == "coder" else CONTRACTS.get(entry.kind)
    if contract is None:
        hold(callable(target) or entry.kind == "executor", f"{whose} is not callable", f"{entry.target}: see the docs")
        return "can be imported"
    if inspect.isclass(target):
        _follows(target, contract, whose)
    if entry.kind in MADE_WITH_SETTINGS:
        return f"has the signatures of {contract.__name__}"
    made = make(entry, plugins)
    if made is not None:
        _follows(made, contract, whose)
    settings = _check_settings(entry, plugins, whose) if entry.kind in ("pruner", "coder", "density control") else ""
    return f"is made with its defaults{settings}, and has the signatures of {contract.__name__}"


def make(entry: Entry, plugins: PluginManager) -> Any:
    """Return an object of what an entry stands for, with its defaults; what is an object already, as it is.

    Raises NotCheckedError if the entry itself says that it cannot be made here, BrokenContractError if making fails.
    """
    target, whose = entry.load(), f"{entry.kind} '{entry.name}'"
    _obstacle(entry)
    try:
        if entry.kind == "method":
            return target(plugins, target.Config())
        if entry.kind == "coder" and entry.declared.get("codes") in ("gaussians", "vectors"):
            return target(plugins)
        is_object = not callable(target) or (entry.kind == "dataset" and not inspect.isclass(target))
        return target if is_object else target()
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise BrokenContractError(
            f"{whose} cannot be made with its defaults: {reason}", f"{entry.target}: give every setting a default"
        ) from error


def _check_settings(entry: Entry, plugins: PluginManager, whose: str) -> str:
    """Hold `Settings` of a provider, if it has any, to defaults that it is made with; return how many there are."""
    target = entry.load()
    model = getattr(target, "Settings", None)
    if model is None:
        return ""
    mend = f"{entry.target}: Settings is a pydantic model whose fields have defaults, each an argument of the class"
    try:
        settings = model().model_dump(mode="json")
        target(*([plugins] if entry.kind == "coder" else []), **settings)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise BrokenContractError(f"{whose} cannot be made with its Settings: {reason}", mend) from error
    arguments = inspect.signature(target).parameters
    for name, value in settings.items():
        default = arguments[name].default if name in arguments else value
        hold(
            default in (value, inspect.Parameter.empty),
            f"{whose}: '{name}' is {default!r} or {value!r} by default",
            mend,
        )
    return f" and its {len(settings)} settings"


def _obstacle(entry: Entry) -> None:
    """Raise NotCheckedError for what says that it cannot be used on this machine."""
    if entry.kind == "rasterizer":
        info = api.RasterizerInfo.from_entry(entry)
        if "cpu" not in info.devices:
            reason: str | None = f"it draws on {', '.join(sorted(info.devices))} alone"
        else:
            reason = info.obstacle("cpu")
    else:
        module, _, function = str(entry.declared.get("available", "")).partition(":")
        reason = getattr(importlib.import_module(module), function)() if module else None
    if reason is not None:
        raise NotCheckedError(f"{entry.kind} '{entry.name}' cannot be used here: {reason}", "check where it can be")


def _check_command(target: Any, whose: str) -> str:
    import click

    hold(isinstance(target, click.Command), f"{whose} stands for a {type(target).__name__}", "use @click.command()")
    told = target.get_short_help_str(limit=200).strip()
    hold(told, f"{whose} has no help", "write a docstring: its first line is the help")
    missing = [
        each.name
        for each in target.params
        if isinstance(each, click.Option) and not each.help and not each.hidden and each.name is not None
    ]
    hold(not missing, f"{whose}: no help for --{', --'.join(missing)}", "click.option(..., help=...)")
    return "has help"


def _follows(found: Any, contract: type, whose: str) -> None:
    """Hold a class or an object to have every member of a contract, and to take the arguments of its functions."""
    for name in ["__call__"] if contract is api.ContextModel else [n for n in vars(contract) if not n.startswith("_")]:
        expected = inspect.getattr_static(contract, name)
        if not inspect.isfunction(expected):
            is_class = inspect.isclass(found)  # an attribute may be set when it is made
            hold(is_class or hasattr(found, name), f"{whose} has no '{name}'", f"the contract is {contract.__name__}")
            continue
        hold(callable(getattr(found, name, None)), f"{whose} has no {name}()", f"the contract is {contract.__name__}")
        if name != "__call__":
            _same_arguments(found, name, expected, whose)


def _same_arguments(found: Any, name: str, expected: Callable[..., Any], whose: str) -> None:
    """Hold a function to take what its contract's is called with: as many by position, the others by name."""
    signature = inspect.signature(getattr(found, name))
    wanted = list(inspect.signature(expected).parameters.values())
    if not inspect.isclass(found) or isinstance(inspect.getattr_static(found, name), (staticmethod, classmethod)):
        wanted = wanted[1:]  # without self
    positional = [p for p in wanted if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    by_name = {p.name: None for p in wanted if p.kind is p.KEYWORD_ONLY}
    text = f"{name}({', '.join(str(p) for p in wanted if p.name != 'self')})"
    try:
        signature.bind(*[None] * len(positional), **by_name)
        signature.bind(*[None] * sum(p.default is p.empty for p in positional))
    except TypeError as error:
        raise BrokenContractError(
            f"{whose}: {name}{signature} cannot be called so: {error}", f"it is {text}"
        ) from error


def _takes(function: Callable[..., Any], count: int, whose: str) -> None:
    try:
        inspect.signature(function).bind(*[None] * count)
    except TypeError as error:
        raise BrokenContractError(
            f"{whose} cannot be called with {count} arguments: {error}", "docs/plugins.md has the call"
        ) from error
    except ValueError:  # a builtin that does not tell
        return

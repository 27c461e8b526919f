"""`sw config`: every key of --set for a method, with type, bounds, value and meaning."""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.tooling import (
    debug_option,
    json_option,
    load_plugins,
    name_of,
    options,
    preset_option,
    print_facts,
    print_table,
    rates_option,
)

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

    from splatwizard_core.tooling import PluginManager

BOUNDS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<", "min_length": "length >=", "max_length": "length <="}
HEADS = ("key", "value", "type", "bounds", "meaning")
SETTINGS = "settings"  # last part of the key of a provider's values


@click.command("config", short_help="every key of --set for a method")
@click.argument("method", type=name_of("method"))
@options(
    preset_option, rates_option,
    click.option("--only", metavar="TEXT", default="", help="Keys that hold this text.  [default: all]"),
    json_option, debug_option,
)  # fmt: skip
def config(method: str, preset: str | None, rate: str | None, only: str, as_json: bool) -> None:
    """Print the keys that --set takes for METHOD: its own, those of the run, of the scene, and of metrics.

    Values are those of the preset and rate point; units stand in the meaning. For a method that starts from the trained
    scene of another, the other's keys are taken as pretrained.KEY.
    """
    found = {block: [row for row in rows if only in row["key"]] for block, rows in blocks(method, preset, rate)}

    def told(_: dict[str, Any]) -> None:
        for block, rows in found.items():
            if rows:
                print_table(list(HEADS), [[row[head] for head in HEADS] for row in rows], title=block)

    if not any(found.values()):
        raise click.UsageError(f"no key of {method} holds '{only}': leave out --only to see all")
    print_facts({"method": method, "keys": found}, as_json, told)


def blocks(method: str, preset: str | None, rate: str | None) -> Iterator[tuple[str, list[dict[str, str]]]]:
    """Yield title and rows of each block of keys. Raises ConfigError for a preset or rate point that is none."""
    from splatwizard_core.api import SceneOptions
    from splatwizard_core.tooling import SceneParams, resolve

    plugins = load_plugins()
    found = resolve(plugins.methods.load(method), preset or "paper", rate, plugins=plugins)
    yield f"{method}, preset {found.preset}, rate {found.rate}", list(rows_of(found.config, plugins))
    yield "run", list(rows_of(found.ppl, plugins))
    told = re.findall(r"^    (\w+(?:, \w+)*) +(.+)$", SceneOptions.__doc__ or "", re.M)
    meanings = {name: meaning for names, meaning in told for name in names.split(", ")}
    yield "scene", [each | {"meaning": meanings.get(each["key"], "")} for each in rows_of(SceneParams(), plugins)]
    groups = {
        str(entry.declared.get("group", entry.name)): entry
        for entry in plugins.metrics
        if entry.declared.get("settings")
    }
    models = {name: _imported(str(entry.declared["settings"])) for name, entry in groups.items()}
    yield "metrics", [row for name, model in models.items() for row in rows_of(model(), plugins, f"metrics.{name}.")]


def rows_of(block: BaseModel, plugins: PluginManager, prefix: str = "") -> Iterator[dict[str, str]]:
    """Yield a row for each value of a block, blocks inside it and settings of what it names entered."""
    from pydantic import BaseModel

    for name, field in type(block).model_fields.items():
        value = getattr(block, name)
        key = prefix + name
        if isinstance(value, BaseModel):
            yield from rows_of(value, plugins, f"{key}.")
        elif name == SETTINGS and isinstance(value, dict) and value:
            described = _settings_model(block, plugins)
            for setting, given in value.items():
                inside = described.model_fields.get(setting) if described is not None else None
                yield row(f"{key}.{setting}", given, inside)
        elif name != SETTINGS:
            yield row(key, value, field)


def row(key: str, value: Any, field: FieldInfo | None) -> dict[str, str]:
    """One line: texts by column."""
    told = {"key": key, "value": _spelled(value), "type": type(value).__name__, "bounds": "", "meaning": ""}
    if field is not None:
        told["type"] = type_name(field.annotation)
        told["meaning"] = field.description or ""
        limits = ((sign, getattr(mark, name, None)) for mark in field.metadata for name, sign in BOUNDS.items())
        told["bounds"] = ", ".join(f"{sign} {limit:g}" for sign, limit in limits if isinstance(limit, (int, float)))
    return told


def type_name(annotation: Any) -> str:
    """Spell a type for people: `float or none`, `auto | cpu | cuda`, `list of text`."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return type_name(arguments[0])
    if origin is typing.Literal:
        return " | ".join(map(str, arguments))
    if origin in (list, tuple, set, frozenset):
        inside = [type_name(each) for each in arguments if each is not Ellipsis]
        return f"list of {inside[0]}" if inside else "list"
    if arguments and origin is not dict:
        return " or ".join(type_name(each) for each in arguments)
    if annotation is type(None):
        return "none"
    return {str: "text", dict: "table"}.get(origin or annotation, getattr(origin or annotation, "__name__", "any"))


def _settings_model(block: BaseModel, plugins: PluginManager) -> type[BaseModel] | None:
    """Return the pydantic model of the settings of what a block names; None if there is none."""
    from sw_gaussians.choices import Choice

    chosen = block.provider(plugins, "") if isinstance(block, Choice) else None
    found: type[BaseModel] | None = getattr(chosen, "Settings", None)
    return found


def _imported(target: str) -> type[BaseModel]:
    import importlib

    module, _, attribute = target.partition(":")
    found: type[BaseModel] = getattr(importlib.import_module(module), attribute)
    return found


def _spelled(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return ",".join(map(_spelled, value))
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)

"""Dotted keys of nested configuration blocks: listing, types, access, and suggestions for typos."""

from __future__ import annotations

import difflib
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from splatwizard_core.base.values import members
from splatwizard_core.training.params import PipelineParams, ReadsFile, SceneParams


def block_of(annotation: Any) -> type[BaseModel] | None:
    """Return the block class of a field that holds one, else None."""
    blocks = (m for m in members(annotation) if isinstance(m, type) and issubclass(m, BaseModel))
    return next(blocks, None)


def leaves(cls: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yield dotted key and field of every value, blocks entered."""
    for name, field in cls.model_fields.items():
        inner = block_of(field.annotation)
        if inner is not None:
            yield from leaves(inner, f"{prefix}{name}.")
        else:
            yield prefix + name, field


def block_keys(cls: type[BaseModel]) -> dict[str, str]:
    """Map the dotted key of every value to its description."""
    return {key: field.description or "" for key, field in leaves(cls)}


def input_files(cls: type[BaseModel]) -> list[str]:
    """List the dotted keys of the fields that name a file which training reads."""
    return marked(cls, ReadsFile)


def marked(cls: type[BaseModel], mark: type) -> list[str]:
    """List the dotted keys of the fields whose type is annotated with an instance of `mark`."""
    return [key for key, field in leaves(cls) if any(isinstance(each, mark) for each in field.metadata)]


def field_at(cls: type[BaseModel], key: str) -> Any:
    """Return the type of a dotted key; None if there is no such key.

    Keys of a dict field are free; below one of `Any` or `object` they are free all the way down.
    """
    annotation: Any = cls
    for part in key.split("."):
        block = block_of(annotation)
        if block is not None:
            if part not in block.model_fields:
                return None
            annotation = block.model_fields[part].annotation
            continue
        annotation = next((typing.get_args(m)[1] for m in members(annotation) if typing.get_origin(m) is dict), None)
        if annotation in (None, Any, object):
            return annotation
    return annotation


def set_at(content: dict[str, Any], key: str, value: Any) -> None:
    """Put a value at a dotted key of nested dicts."""
    *path, last = key.split(".")
    for part in path:
        if not isinstance(content.get(part), dict):
            content[part] = {}
        content = content[part]
    content[last] = value


def remove_at(content: dict[str, Any], key: str) -> None:
    """Remove the value at a dotted key of nested dicts, if there is one."""
    *path, last = key.split(".")
    for part in path:
        content = content.get(part, {})
    content.pop(last, None)


def flatten(cls: type[BaseModel], tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested tables as dotted keys, as deep as `cls` has blocks; what it does not know stays as it is."""
    found: dict[str, Any] = {}
    for name, value in tables.items():
        field = cls.model_fields.get(name)
        inner = block_of(field.annotation) if field is not None else None
        if inner is not None and isinstance(value, Mapping):
            found |= flatten(inner, value, f"{prefix}{name}.")
        elif field is None and isinstance(value, Mapping) and prefix:
            found |= {f"{prefix}{name}.{k}": v for k, v in value.items()}
        else:
            found[prefix + name] = value
    return found


def dotted(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested tables as dotted keys, all the way down."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        found |= dotted(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def suggest(key: str, known: Sequence[str]) -> str | None:
    """Find the nearest valid key: one that ends in it, or one that is spelt like it."""
    ends = [k for k in known if k.endswith(f".{key}")]
    near = ends or difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    if near:
        return near[0]
    ends_of = {k.rpartition(".")[2]: k for k in known}
    near = difflib.get_close_matches(key.rpartition(".")[2], list(ends_of), n=1, cutoff=0.75)
    return ends_of[near[0]] if near else None


def is_beside_method(config: type[BaseModel], key: str) -> bool:
    """Whether a key is none of a method's `config` but one of the run, of the scene that it starts from, or of how the
    pictures are read.
    """
    besides = any(field_at(beside, key) for beside in (PipelineParams, SceneParams)) or key.startswith("pretrained.")
    return field_at(config, key) is None and besides


def value_at(config: BaseModel, key: str) -> Any:
    """Return the value at a dotted key, blocks as plain dicts."""
    value: Any = config.model_dump()
    for part in key.split("."):
        value = value[part]
    return value

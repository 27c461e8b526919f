"""Overrides of configuration values by dotted key: parsed by field type, checked, errors explained."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from splatwizard_core.base.values import parse_text
from splatwizard_core.errors import ConfigError
from splatwizard_core.training.keys import block_keys, field_at, set_at, suggest
from splatwizard_core.training.params import OptimizationParams

_REASONS = {
    "int_parsing_size": "a whole number that fits 64 bits",
    "extra_forbidden": "left out: there is no such key",
    "string_too_short": "a text that is not empty",
}
"""Kind of pydantic's error -> what a value must be, where its own words do not say."""
ModelT = TypeVar("ModelT", bound=BaseModel)


def apply_overrides(config: ModelT, values: Mapping[str, Any], *, source: str, known: Collection[str] = ()) -> ModelT:
    """Return `config` with some values replaced.

    values  by dotted key; strings are parsed by the field's type ("true", "3e4", "[1, 2]", "none")
    source  where they come from, for the message: "--set", "preset 'quick'", a file name
    known   keys that a message may suggest besides those of its blocks

    Raises ConfigError for an unknown key (with the nearest valid one) or a bad value.
    """
    cls = type(config)
    values = config.spelled(values) if isinstance(config, OptimizationParams) else values
    content = config.model_dump()
    for key, value in values.items():
        annotation = field_at(cls, key)
        if annotation is None:
            raise unknown_key(key, [*block_keys(cls), *known], source)
        try:
            set_at(content, key, _bounded(parse_text(annotation, value) if isinstance(value, str) else value))
        except ValueError as error:
            raise ConfigError(f"bad value '{value}' for '{key}' in {source}: {error}", key=key) from None
    try:
        return cls.model_validate(content)
    except ValidationError as error:
        raise _bad_value(error, values, source, block_keys(cls)) from None


def _bounded(value: Any) -> Any:
    """Return a value as it is. Raises ValueError for an integer, alone or in a list, that does not fit 64 bits."""
    if any(isinstance(x, int) and abs(x) >= 1 << 63 for x in (value if isinstance(value, list | tuple) else [value])):
        raise ValueError("an integer does not fit 64 bits")
    return value


def unknown_key(key: str, known: Collection[str], source: str) -> ConfigError:
    """Make the error for an unknown key, with the nearest valid one."""
    near = suggest(key, list(known))
    hint = f"did you mean '{near}'?" if near else _keys_beside(key, known)
    return ConfigError(f"unknown key '{key}' in {source}: {hint}", key=key)


def _bad_value(
    error: ValidationError, values: Mapping[str, Any], source: str, described: Mapping[str, str]
) -> ConfigError:
    first = error.errors()[0]
    # The culprit is the longest given key that the location starts with; a check over several fields has no location.
    path = ".".join(map(str, first["loc"]))
    key = max((k for k in values if path == k or path.startswith(f"{k}.")), key=len, default=path)
    reason = _REASONS.get(first["type"]) or first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    if first["type"] == "missing":
        return ConfigError(f"{source}: '{path}' is missing", key=path)
    if not key:
        return ConfigError(f"bad combination of values in {source}: {reason}")
    value = values.get(key, first.get("input"))
    about = f" ({described[key]})" if described.get(key) else ""
    return ConfigError(f"bad value {value!r} for '{key}' in {source}: must be {reason}{about}", key=key)


def _keys_beside(key: str, known: Collection[str]) -> str:
    """List alternatives: the keys of the named block, else top-level keys."""
    block = key.rpartition(".")[0]
    inside = sorted(k for k in known if block and k.startswith(f"{block}."))
    if inside:
        return f"'{block}' has {', '.join(k.removeprefix(f'{block}.') for k in inside)}"
    return f"the keys are {', '.join(sorted({k.split('.')[0] for k in known}))}"

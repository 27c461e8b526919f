"""JSON as file headers use it: UTF-8, finite numbers, no duplicate keys, bounded nesting, nothing else."""

from __future__ import annotations

import json
import math
from typing import Any

MAX_DEPTH = 32
MAX_INTEGER = 2**63 - 1  # what every JSON reader that uses 64-bit integers can hold
MAX_STRING = 1 << 16

_Path = tuple[Any, Any]
"""(path of the parent or None, key or index)"""


def dump_strict(value: Any) -> bytes:
    """The compact UTF-8 JSON of `value`: keys in the given order, tuples as lists.

    Raises ValueError that names the place of whatever `load_strict` would refuse.
    """
    check_json(value)
    return json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode()


def load_strict(data: bytes) -> Any:
    """The value in `data`. Raises ValueError with the reason; time and memory grow linearly with len(data)."""
    try:
        value = json.loads(
            data.decode(),  # UnicodeDecodeError is a ValueError
            object_pairs_hook=_unique_keys,
            parse_int=_bounded_int,
            parse_constant=_refuse_constant,
        )
    except RecursionError:
        raise ValueError(f"nested deeper than {MAX_DEPTH} levels") from None
    check_json(value)
    return value


def check_json(value: Any, path: _Path | None = None, depth: int = 0) -> None:
    """Raise ValueError if `value` is not plain JSON data within the bounds of this module.

    path, depth     where it stands; a path is spelled out only for a message
    """
    if isinstance(value, (list, tuple, dict)):
        if depth >= MAX_DEPTH:
            raise ValueError(f"nested deeper than {MAX_DEPTH} levels")
        for step, each in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(value, dict):
                if not isinstance(step, str):
                    raise ValueError(f"'{_place(path)}': key {step!r} is not a string")
                _check_text(step, path)
            check_json(each, (path, step), depth + 1)
    elif isinstance(value, str):
        _check_text(value, path)
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"'{_place(path)}': {value} is not a finite number")
    elif isinstance(value, int):  # bool among them
        if abs(value) > MAX_INTEGER:
            raise ValueError(f"'{_place(path)}': an integer does not fit 64 bits")
    elif value is not None:
        raise ValueError(f"'{_place(path)}': {type(value).__name__} is not JSON data")


def _place(path: _Path | None) -> str:
    """Such as `static.sizes[3]`; long keys are cut."""
    steps: list[str] = []
    while path is not None:
        path, step = path
        steps.append(f"[{step}]" if isinstance(step, int) else f".{step[:80]}")
    return "".join(reversed(steps)).removeprefix(".")


def _check_text(text: str, path: _Path | None) -> None:
    if len(text) > MAX_STRING:
        raise ValueError(f"'{_place(path)}': a string of {len(text):,} characters is longer than {MAX_STRING:,}")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"'{_place(path)}': a string holds a lone surrogate") from None


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key '{key[:80]}' appears twice")
        found[key] = value
    return found


def _bounded_int(digits: str) -> int:
    if len(digits) > 20:  # int() of a very long string takes quadratic time on older interpreters
        raise ValueError("an integer does not fit 64 bits")
    return int(digits)


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a finite number")

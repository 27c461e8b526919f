"""JSON as file headers use it: UTF-8, finite numbers, no duplicate keys, bounded nesting, nothing else."""

from __future__ import annotations

import json
import math
from typing import Any

MAX_DEPTH = 32
MAX_INTEGER = 2**63 - 1  # what every JSON reader that uses 64-bit integers can hold
MAX_STRING = 1 << 16


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


def check_json(value: Any) -> None:
    """Raise ValueError if `value` is not plain JSON data within the bounds of this module."""
    stack: list[tuple[Any, str, int]] = [(value, "", 1)]
    while stack:
        item, place, depth = stack.pop()
        if depth > MAX_DEPTH:
            raise ValueError(f"nested deeper than {MAX_DEPTH} levels")
        if item is None or isinstance(item, bool):
            continue
        if isinstance(item, int):
            if abs(item) > MAX_INTEGER:
                raise ValueError(f"'{place}': an integer does not fit 64 bits")
        elif isinstance(item, float):
            if not math.isfinite(item):
                raise ValueError(f"'{place}': {item} is not a finite number")
        elif isinstance(item, str):
            _check_text(item, place)
        elif isinstance(item, (list, tuple)):
            stack += [(each, f"{place}[{i}]", depth + 1) for i, each in enumerate(item)]
        elif isinstance(item, dict):
            for key, each in item.items():
                if not isinstance(key, str):
                    raise ValueError(f"'{place}': key {key!r} is not a string")
                _check_text(key, place)
                stack.append((each, f"{place}.{key}" if place else key, depth + 1))
        else:
            raise ValueError(f"'{place}': {type(item).__name__} is not JSON data")


def _check_text(text: str, place: str) -> None:
    if len(text) > MAX_STRING:
        raise ValueError(f"'{place[:80]}': a string of {len(text):,} characters is longer than {MAX_STRING:,}")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"'{place[:80]}': a string holds a lone surrogate") from None


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

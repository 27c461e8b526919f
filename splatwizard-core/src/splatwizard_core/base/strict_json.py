"""JSON as file headers use it: UTF-8, finite numbers, no duplicate keys, bounded nesting, nothing else."""

from __future__ import annotations

import json
import math
import re
from typing import Any

MAX_DEPTH = 32
MAX_INTEGER = 2**63 - 1  # what every JSON reader that uses 64-bit integers can hold
MAX_STRING = 1 << 16

SURROGATE = re.compile("[\ud800-\udfff]")


def dump_strict(value: Any) -> bytes:
    """The compact UTF-8 JSON of `value`: keys in the given order, tuples as lists.

    Raises ValueError that names the place of whatever `load_strict` would refuse.
    """
    check_json(value)
    return json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode()


def load_strict(data: bytes) -> Any:
    """The value in `data`. Raises ValueError with the reason; time and memory grow linearly with len(data)."""
    try:
        text = data.decode()  # UnicodeDecodeError is a ValueError
        value = json.loads(text, object_pairs_hook=_unique_keys, parse_int=_bounded_int)
    except RecursionError:
        raise ValueError(f"nested deeper than {MAX_DEPTH} levels") from None
    check_json(value)
    return value


def json_reason(error: Exception) -> str:
    """Say why text is no JSON, after what `json.loads` raised."""
    return "its brackets are nested too deeply" if isinstance(error, RecursionError) else str(error)


def check_json(value: Any, place: str = "", depth: int = 0) -> None:
    """Raise ValueError if `value` is not plain JSON data within the bounds of this module.

    place   where it stands, for messages, such as `static.sizes[3]`; long keys are cut
    """
    problem = None
    if isinstance(value, (list, tuple, dict)) and depth >= MAX_DEPTH:
        raise ValueError(f"nested deeper than {MAX_DEPTH} levels")
    if isinstance(value, dict):
        for key, each in value.items():
            if not isinstance(key, str):
                raise ValueError(f"'{place}': key {key!r} is not a string")
            check_json(key, place)
            check_json(each, f"{place}.{key[:80]}" if place else key[:80], depth + 1)
    elif isinstance(value, (list, tuple)):
        for i, each in enumerate(value):
            if type(each) is not int or abs(each) > MAX_INTEGER:  # most of a long list needs no name
                check_json(each, f"{place}[{i}]", depth + 1)
    elif isinstance(value, str):
        if len(value) > MAX_STRING:
            problem = f"a string of {len(value):,} characters is longer than {MAX_STRING:,}"
        elif SURROGATE.search(value):
            problem = "a string holds a lone surrogate"
    elif isinstance(value, float):
        if not math.isfinite(value):
            problem = f"{value} is not a finite number"
    elif isinstance(value, int):  # bool among them
        if abs(value) > MAX_INTEGER:
            problem = "an integer does not fit 64 bits"
    elif value is not None:
        problem = f"{type(value).__name__} is not JSON data"
    if problem is not None:
        raise ValueError(f"'{place}': {problem}")


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

"""Parse text of the command line into values, by the type of the field that takes them."""

from __future__ import annotations

import enum
import json
import typing
from collections.abc import Mapping
from typing import Any, Literal

from splatwizard_core.training.keys import block_of, members

_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")
_NONE = ("none", "null")


def parse_text(annotation: Any, text: str) -> Any:
    """Return the value that `text` means for a field of this type; bounds are checked elsewhere.

    bool        true/false, yes/no, on/off, 1/0
    int, float  as in Python, `30_000` and `3e4` included
    list, tuple, set    `1,2,3` or `[1, 2, 3]`; empty text is empty
    Literal, Enum       one of the choices
    X | None    `none` besides what X takes

    Raises ValueError whose text says what was expected.
    """
    options = members(annotation)
    if type(None) in options and text.lower() in _NONE:
        return None
    candidates = [o for o in options if o is not type(None)]
    # Text fits a str field always, so it is tried last.
    candidates.sort(key=lambda o: o is str)
    problem: ValueError | None = None
    for candidate in candidates:
        try:
            return _parse_one(candidate, text)
        except ValueError as error:
            problem = problem or error
    raise problem or ValueError("expected none")


def _parse_one(kind: Any, text: str) -> Any:
    origin = typing.get_origin(kind) or kind
    if kind is bool:
        return _bool(text)
    if kind is int:
        return _int(text)
    if kind is float:
        return _float(text)
    if origin is Literal:
        return _choice({str(c): c for c in typing.get_args(kind)}, text)
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        return _choice({**{m.name: m for m in kind}, **{str(m.value): m for m in kind}}, text)
    if origin in (list, tuple, set, frozenset):
        return _sequence(kind, text)
    if origin in (dict, Mapping):
        value = _json(text)
        if not isinstance(value, dict):
            raise ValueError('expected a JSON object such as {"a": 1}')
        return value
    if block_of(kind) is not None:
        raise ValueError("this is a block, set one of its keys")
    if kind is Any:
        try:
            return json.loads(text)
        except ValueError:
            return text
    return text


def _bool(text: str) -> bool:
    if text.lower() in _TRUE or text.lower() in _FALSE:
        return text.lower() in _TRUE
    raise ValueError("expected true or false")


def _int(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        value = float(text)
    except ValueError:
        raise ValueError("expected a whole number") from None
    if not value.is_integer():
        raise ValueError("expected a whole number")
    return int(value)


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError("expected a number") from None


def _choice(choices: Mapping[str, Any], text: str) -> Any:
    if text not in choices:
        raise ValueError(f"expected one of {', '.join(choices)}")
    return choices[text]


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        raise ValueError("expected JSON") from None


def _sequence(kind: Any, text: str) -> list[Any]:
    arguments = [a for a in typing.get_args(kind) if a is not Ellipsis]
    stripped = text.strip()
    if _is_bracketed(stripped):
        stripped = stripped[1:-1].strip()
    parts = _split(stripped)
    if not arguments:
        arguments = [str]
    each = arguments * len(parts) if len(arguments) == 1 else arguments
    if len(each) != len(parts):
        raise ValueError(f"expected {len(each)} values, separated by commas")
    return [parse_text(a, p.strip().strip("\"'")) for a, p in zip(each, parts, strict=True)]


def _is_bracketed(text: str) -> bool:
    """Whether the first character opens a bracket that the last one closes."""
    depth = 0
    for i, character in enumerate(text):
        depth += (character in "[(") - (character in ")]")
        if depth == 0:
            return i == len(text) - 1 and i > 0
    return False


def _split(text: str) -> list[str]:
    """Split at commas that stand in no bracket."""
    parts, depth, last = [], 0, 0
    for i, character in enumerate(text):
        depth += (character in "[({") - (character in "])}")
        if character == "," and depth == 0:
            parts.append(text[last:i])
            last = i + 1
    parts.append(text[last:])
    return [p for p in (part.strip() for part in parts) if p]

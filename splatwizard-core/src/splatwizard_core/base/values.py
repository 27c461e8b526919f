"""Parse text of the command line into values, by the type of the field that takes them."""

from __future__ import annotations

import contextlib
import enum
import json
import re
import types
import typing
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, Union

from pydantic import BaseModel, TypeAdapter

from splatwizard_core.errors import UserInputError

_SIZE = re.compile(r"\s*(\d{1,15}(?:\.\d{0,9})?|\.\d{1,9})\s*(?:([kmg])(i?))?b?\s*", re.IGNORECASE | re.ASCII)


def members(annotation: Any) -> list[Any]:
    """Return the alternatives of a union (NoneType among them), or the one type, without Annotated[...] around it."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return members(arguments[0])
    if origin in (Union, types.UnionType):
        return [member for argument in arguments for member in members(argument)]
    return [annotation]


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
    if type(None) in options and text.lower() in ("none", "null"):
        return None
    problem: ValueError | None = None
    # Text fits a str field always, so it is tried last.
    for kind in sorted((o for o in options if o is not type(None)), key=lambda o: o is str):
        try:
            return _parse_one(kind, text)
        except ValueError as error:
            problem = problem or error
    raise problem or ValueError("expected none")


def parse_size(text: str | int) -> int:
    """Return bytes, 1 to 2^50, of `500000`, `500kB` (10^3), `8MB`, `1.5GB` or `8MiB` (2^20). Raises UserInputError."""
    found = _SIZE.fullmatch(str(text))
    size = float(found[1]) * (1024 if found[3] else 1000) ** " kmg".index((found[2] or " ").lower()) if found else 0
    if not 1 <= size <= 1 << 50:
        raise UserInputError(
            f"'{text!s:.80}' is no size: give bytes, 1 to 2^50, or a number with kB, MB, GB, KiB, MiB or GiB, as 8MB"
        )
    return int(size)


def _whole_number(text: str) -> int:
    with contextlib.suppress(ValueError):
        return int(text)
    value = float(text)
    if not value.is_integer():
        raise ValueError
    return int(value)


_json_object = TypeAdapter(dict[str, Any]).validate_json
_READERS: Mapping[Any, tuple[Callable[[str], Any], str]] = {
    bool: (TypeAdapter(bool).validate_python, "true or false"),
    int: (_whole_number, "a whole number"),
    float: (float, "a number"),
    dict: (_json_object, 'a JSON object such as {"a": 1}'),
    Mapping: (_json_object, 'a JSON object such as {"a": 1}'),
}
"""Type -> what reads its text, raising ValueError, and what it expects."""


def _parse_one(kind: Any, text: str) -> Any:
    origin = typing.get_origin(kind) or kind
    if origin in _READERS:
        read, expected = _READERS[origin]
        try:
            return read(text)
        except ValueError:
            raise ValueError(f"expected {expected}") from None
    if origin is Literal:
        return _choice({str(c): c for c in typing.get_args(kind)}, text)
    if origin in (list, tuple, set, frozenset):
        return _sequence(kind, text)
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        return _choice({**{m.name: m for m in kind}, **{str(m.value): m for m in kind}}, text)
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        raise ValueError("this is a block, set one of its keys")
    if kind is Any:
        with contextlib.suppress(ValueError, RecursionError):
            return json.loads(text)
    return text


def _choice(choices: Mapping[str, Any], text: str) -> Any:
    if text not in choices:
        raise ValueError(f"expected one of {', '.join(choices)}")
    return choices[text]


def _sequence(kind: Any, text: str) -> list[Any]:
    text = text.strip()
    parts = _split(text)
    if len(parts) == 1 and text[0] in "[(" and text[-1] in "])":
        parts = _split(text[1:-1])
    each = [a for a in typing.get_args(kind) if a is not Ellipsis] or [str]
    if len(each) == 1:
        each *= len(parts)
    if len(each) != len(parts):
        raise ValueError(f"expected {len(each)} values, separated by commas")
    return [parse_text(a, p.strip("\"'")) for a, p in zip(each, parts, strict=True)]


def _split(text: str) -> list[str]:
    """Split at commas that stand in no bracket."""
    parts, depth = [""], 0
    for character in text:
        depth += (character in "[({") - (character in "])}")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [p for p in (part.strip() for part in parts) if p]

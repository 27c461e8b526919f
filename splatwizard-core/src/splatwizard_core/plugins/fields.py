"""Rules that every entry keeps to, so that no command stumbles over it: its name, the types of its declared fields."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

NAME = re.compile(r"\w[\w.+-]{0,63}")
TEXTS = (
    "label", "group", "unit", "settings", "suffix", "codes", "stores", "looks_for", "without_poses", "title", "prefix",
)  # fmt: skip
NUMBERS = ("position", "digits", "bd_anchor")
LISTS = ("aliases", "presets", "rates", "scenes", "table_scenes", "folders")


def illegal(kind: str, name: object, declared: Mapping[str, Any]) -> str | None:
    """Return in one line why an entry is refused; None: it is legal. A rasterizer's other fields check themselves."""
    if not isinstance(name, str) or not (name.isprintable() if kind == "check" else NAME.fullmatch(name)):
        return f"{name!r:.80} is no name: it has letters, digits and . _ + - only, 64 at most"
    try:
        json.dumps(declared, allow_nan=False)
    except (TypeError, ValueError) as error:
        return f"it declares something that is no plain value: {error}"
    for field, value in declared.items():
        wanted = _wanted(field, value)
        if wanted is not None:
            return f"it declares {field}={value!r:.80}; it must be {wanted}"
    return None


def _wanted(field: str, value: Any) -> str | None:
    """Return what a field must be that is something else; None: it is right, or not known here."""
    texts: list[Any] = [value] if isinstance(value, str) else [*value] if isinstance(value, (list, tuple)) else [None]
    are_texts = all(isinstance(each, str) for each in texts)
    if field == "direction" and value not in ("higher", "lower"):
        return "'higher' or 'lower'"
    if field == "over" and value not in ("image", "views", "model"):
        return "'image', 'views' or 'model'"
    if field in TEXTS and not isinstance(value, str):
        return "a text"
    if field in NUMBERS and not isinstance(value, (int, float)):
        return "a number"
    if field in LISTS and not (are_texts and isinstance(value, (list, tuple))):
        return "a list of texts"
    if field == "native" and value and not (are_texts and all(re.fullmatch(r"[\w.]+:[\w.]+", each) for each in texts)):
        return "'module:attribute', or a list of such"
    if field == "published" and not (isinstance(value, str) and re.fullmatch(r"[\w.]+:[\w.-]+\.toml", value)):
        return "'package:file.toml', a file in that package"
    return None

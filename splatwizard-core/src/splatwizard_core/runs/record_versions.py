"""Older result records, brought to the schema of this release: what they did not measure is null, with that reason."""

from __future__ import annotations

import json
from typing import Any

OF_SCHEMA_1 = "the record is of schema 1, which did not hold it"
OF_SCHEMA_2 = "the record is of schema 2 or older, which did not hold it"
NEW_IN_2 = {
    "speed": ("jit_s", "load_s", "spread"),
    "memory": ("peak_load_bytes",),
    "codec": ("decode_spread", "jit_s"),
    "train": ("pictures_in",),
}


def upgraded(text: str) -> str:
    """The JSON of a record as the current schema has it; text that is no older record comes back as it is."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return text  # whoever reads it says what is wrong
    version = content.get("schema_version") if isinstance(content, dict) else None
    if type(version) is not int or version not in (1, 2):  # true is a 1 to Python
        return text
    if version == 1:
        content = _from_1_to_2(content)
    return json.dumps(_from_2_to_3(content))


def _from_1_to_2(content: dict[str, Any]) -> dict[str, Any]:
    """Schema 2 tells loading and compiling apart, and keeps the spread of repeated measurements."""
    unknown = content.get("unknown")
    if not isinstance(unknown, dict):
        return content
    found = {**content, "schema_version": 2, "unknown": dict(unknown)}
    for block, names in NEW_IN_2.items():
        if not isinstance(content.get(block), dict):
            return content
        found[block] = {**content[block], **dict.fromkeys(names)}
        found["unknown"] |= {f"{block}.{name}": OF_SCHEMA_1 for name in names}
    found["speed"]["repeats"] = 1
    return found


def _from_2_to_3(content: dict[str, Any]) -> dict[str, Any]:
    """Schema 3 says what a training started from, and who served each phase."""
    unknown, train = content.get("unknown"), content.get("train")
    if content.get("schema_version") != 2 or not isinstance(unknown, dict) or not isinstance(train, dict):
        return content
    return {
        **content,
        "schema_version": 3,
        "train": {**train, "pretraining": None},
        "phases": None,
        "unknown": {**unknown, "train.pretraining": OF_SCHEMA_2, "phases": OF_SCHEMA_2},
    }

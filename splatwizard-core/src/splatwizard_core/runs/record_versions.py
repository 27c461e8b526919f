"""Older result records, brought to the schema of this release: what they did not measure is null, with that reason."""

from __future__ import annotations

import json

NEW_SINCE: dict[int, dict[str, tuple[str, ...]]] = {
    # Schema 2 tells loading and compiling apart, and keeps the spread of repeated measurements.
    1: {
        "speed": ("jit_s", "load_s", "spread"),
        "memory": ("peak_load_bytes",),
        "codec": ("decode_spread", "jit_s"),
        "train": ("pictures_in",),
    },
    # Schema 3 says what a training started from, and who served each phase.
    2: {"train": ("pretraining",), "": ("phases",)},
}
"""Schema -> block (empty: the record itself) -> values that it did not hold and the next one does."""
REASONS = {
    1: "the record is of schema 1, which did not hold it",
    2: "the record is of schema 2 or older, which did not hold it",
}


def upgraded(text: str) -> str:
    """The JSON of a record as the current schema has it; text that is no older record comes back as it is."""
    try:
        content = json.loads(text)
        version = content["schema_version"]
        if type(version) is not int or version not in NEW_SINCE:  # true is a 1 to Python
            return text
        for older in range(version, max(NEW_SINCE) + 1):
            for block, names in NEW_SINCE[older].items():
                (content[block] if block else content).update(dict.fromkeys(names))
                content["unknown"].update({f"{block}.{name}".lstrip("."): REASONS[older] for name in names})
        if version == 1:
            content["speed"]["repeats"] = 1
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
        return text  # whoever reads it says what is wrong
    return json.dumps({**content, "schema_version": max(NEW_SINCE) + 1})

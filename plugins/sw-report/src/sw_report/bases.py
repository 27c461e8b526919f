"""Trained scenes that methods start from or are taught by, where those of one table were trained differently."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sw_report.configurations import described, differing, texts
from sw_report.declared import encoding_keys
from sw_report.facts import RunFacts

MOST_KEYS = 3
STEPS_NOTE = "Steps: of the trained scene that a method starts from or is taught by + its own."


def bases_notes(runs: Iterable[RunFacts], names: Mapping[int, str]) -> list[str]:
    """Return a line for each method whose scenes the runs start from, or are, with differing values.

    names   of the runs in the table, by `id`
    """
    runs = list(runs)
    bases = list(dict.fromkeys(name for run in runs for name in run.train.pretraining or {}))
    lines = []
    for base in bases:
        users: dict[str, list[str]] = {}
        values: dict[str, dict[str, str]] = {}
        started = False
        for run in runs:
            own = _own(run) if run.method == base else None
            scene = (run.train.pretraining or {}).get(base)
            found = own if scene is None else _started(base, scene.config, scene.steps, scene.file)
            if not found:
                continue
            started = started or scene is not None
            key = repr(sorted(found.items()))
            values[key] = found
            users.setdefault(key, []).append(names[id(run)])
        keys = differing(list(values.values()))
        if len(values) > 1 and started:
            chosen = [key for key in ("file", "iterations") if key in keys] or keys[:MOST_KEYS]
            told = "; ".join(
                f"{', '.join(dict.fromkeys(users[key]))}: {described(values[key], chosen)}" for key in values
            )
            lines.append(f"The {base} scenes of this table were trained differently, so compare with care: {told}.")
    return lines


def _own(run: RunFacts) -> dict[str, str] | None:
    config = (run.config or {}).get("config")
    return _training(run.method, config) if isinstance(config, dict) else None


def _started(method: str, config: dict[str, Any] | None, steps: int | None, file: Mapping[str, str]) -> dict[str, str]:
    if file:
        return texts({"file": file.get("name", "unknown")})
    return _training(method, config) if config is not None else texts({"iterations": steps})


def _training(method: str, config: dict[str, Any]) -> dict[str, str]:
    """Return the values that training depends on, by dotted key: not what only encodes."""
    only_encodes = encoding_keys(method)
    return texts({key: value for key, value in config.items() if key not in only_encodes})

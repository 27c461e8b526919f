"""Configurations of runs: all that was set but the rate point and the seed, so that only equals are ever joined."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sw_report.declared import rate_settings
from sw_report.facts import RunFacts, clean

Configuration = Mapping[str, str]
"""Dotted key -> value as JSON text: of the method, the run, what it started from, and `PRESET`."""

PRESET = "preset"
CHANGES_NO_RESULT = frozenset((
    "seed", "device", "threads", "checkpoint_every", "log_every", "keep_checkpoints", "eval_every", "profile",
))  # fmt: skip
"""Keys of the run that no score or size depends on; the seed tells repeats of one configuration apart."""
NOT_IN_THE_PROTOCOL = ("init_points",)
"""Keys of the scene that do not stand in the protocol's id."""
LAYERS = ("preset ", "data set ", "rate ")
"""Beginnings of the sources that a run brings by itself: any other is a file or an option."""


def configurations(runs: Sequence[RunFacts]) -> list[Configuration]:
    """Return the configuration of each run, all of one method, without what its rate point decides.

    A key belongs to the rate points if one of them sets it in any of the runs: then it counts only where a file or
    --set gave it another value than the rate point's. A key that an older record lacks has the default of the others.
    A key that presets choose by the scene, or that names the scene's own start, tells no runs apart.
    """
    values = [dict(_values(run)) for run in runs]
    sources = [_sources(run) for run in runs]
    rated = {key for source in sources for key, who in source.items() if who.startswith("rate ")}
    usual: dict[tuple[str | None, str | None], dict[str, str]] = {}
    for run, own, source in zip(runs, values, sources, strict=True):
        usual.setdefault((run.preset, run.rate), {}).update(
            (key, text) for key, text in own.items() if not _is_given(_source(source, key))
        )
    for run, source in zip(runs, sources, strict=True):
        if any(_is_given(who) and who != "--set" for who in source.values()):  # its own config.toml, most likely
            keys, settings = rate_settings(run.method, run.preset, run.rate)
            rated |= keys
            usual[run.preset, run.rate] = {**texts(settings), **usual[run.preset, run.rate]}
    blocks = {key.partition(".")[0] for key in rated}
    chosen_by_scene = _chosen_by_scene(runs, values, sources)
    defaults: dict[str, str] = {}
    found = []
    for run, own, source in zip(runs, values, sources, strict=True):
        kept = {}
        for key, text in own.items():
            who = _source(source, key)
            # Beside what a rate point chose, the preset and the defaults follow from it and from the preset's name.
            if key.partition(".")[0] in blocks and (not _is_given(who) or usual[run.preset, run.rate].get(key) == text):
                continue
            if key in chosen_by_scene:
                continue
            kept[key] = text
            if who is None:
                defaults.setdefault(key, text)
        found.append(kept)
    return [{**defaults, **kept} for kept in found]


def _chosen_by_scene(
    runs: Sequence[RunFacts], values: Sequence[Mapping[str, str]], sources: Sequence[Mapping[str, str]]
) -> set[str]:
    """Return keys that nobody set by hand, and that have one value on each scene with each preset."""
    given: set[str] = {PRESET}
    seen: dict[str, dict[tuple[str | None, ...], set[str]]] = {}
    for run, own, source in zip(runs, values, sources, strict=True):
        for key, text in own.items():
            if _is_given(_source(source, key)):
                given.add(key)
            place = (run.dataset, run.scene, run.preset)
            seen.setdefault(key, {}).setdefault(place, set()).add(text)
    return {key for key, places in seen.items() if key not in given and all(len(x) == 1 for x in places.values())}


def differing(found: Sequence[Configuration]) -> list[str]:
    """Keys in which configurations differ."""
    keys = dict.fromkeys(key for each in found for key in each)
    return [key for key in keys if len({each.get(key) for each in found}) > 1]


def described(configuration: Configuration, keys: Sequence[str]) -> str:
    """Values of some keys in a line: `iterations 600, prune.hard [0.3]`."""
    return ", ".join(clean(f"{key} {_plain(configuration.get(key))}") for key in keys)


def seed_of(run: RunFacts) -> int | None:
    """Seed of a run, if its record says it."""
    pipeline = (run.config or {}).get("pipeline")
    found = pipeline.get("seed") if isinstance(pipeline, dict) else None
    found = run.environment.get("seed") if found is None else found
    return found if isinstance(found, int) and not isinstance(found, bool) else None


def _values(run: RunFacts) -> Iterator[tuple[str, str]]:
    """Yield (dotted key, value as JSON) of all that may change a result."""
    config = run.config or {}
    yield PRESET, json.dumps(run.preset)
    yield from texts(config.get("config")).items()
    yield from ((k, v) for k, v in texts(config.get("pipeline")).items() if k not in CHANGES_NO_RESULT)
    yield from ((k, v) for k, v in texts(config.get("scene")).items() if k in NOT_IN_THE_PROTOCOL)
    yield from texts(config.get("pretrained"), "pretrained.").items()
    for name, scene in (run.train.pretraining or {}).items():
        told = {"file": scene.file.get("sha256"), "preset": scene.preset, "steps": scene.steps}
        yield from texts({k: v for k, v in told.items() if v is not None}, f"{name} scene.").items()


def texts(block: object, prefix: str = "") -> dict[str, str]:
    """Flatten tables of tables to dotted keys and JSON texts; an empty table says nothing."""
    found: dict[str, str] = {}
    if isinstance(block, dict):
        for name, value in block.items():
            if isinstance(value, dict):
                found |= texts(value, f"{prefix}{name}.")
            else:
                found[f"{prefix}{name}"] = json.dumps(value, sort_keys=True, default=str)
    return found


def _sources(run: RunFacts) -> dict[str, str]:
    """Sources of the keys that were set: "preset 'quick'", "data set 'db'", "rate 'r2'", "--set" or a file."""
    found = (run.config or {}).get("provenance")
    return {key: who for key, who in found.items() if isinstance(who, str)} if isinstance(found, dict) else {}


def _source(sources: Mapping[str, str], key: str) -> str | None:
    """Source of a key, or of a table that it is in; None: it has its default."""
    while key and key not in sources:
        key = key.rpartition(".")[0]
    return sources.get(key)


def _is_given(who: str | None) -> bool:
    return who is not None and not who.startswith(LAYERS)


def _plain(text: str | None) -> str:
    if text is None:
        return "default"
    value: Any = json.loads(text)
    return value if isinstance(value, str) else text

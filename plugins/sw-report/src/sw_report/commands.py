"""The command that made a run, put together again from its record and the configuration file beside it."""

from __future__ import annotations

import json
import shlex
import sys
from typing import Any

from sw_report.blocks import Column, Table, row
from sw_report.configurations import LAYERS
from sw_report.facts import clean
from sw_report.runs import Run

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LARGEST_CONFIG = 1_000_000  # bytes; a method's whole configuration takes 3,000
BLOCKS = ("config", "pipeline", "scene")


def command_of(run: Run) -> str | None:
    """Return `sw run ...` with every value that was set, or None if the record holds no configuration.

    Values of a configuration file stand as `--config FILE`, where the run was made with that file.
    """
    config = run.facts.config
    if not config:
        return None
    parts = ["sw", "run", "--method", run.facts.method, "--scene", _scene(run)]
    for option, value in (("--preset", run.facts.preset), ("--rate", run.facts.rate)):
        parts += [option, value] if value else []
    provenance = config.get("provenance")
    sources = provenance if isinstance(provenance, dict) else {}
    files = [who for who in sources.values() if isinstance(who, str) and not who.startswith(("--", *LAYERS))]
    for file in dict.fromkeys(files):
        parts += ["--config", file]
    for key, who in sources.items():
        if who == "--set":
            parts += ["--seed", _spelled(value_of(config, key))] if key == "seed" else [
                "--set", f"{key}={_spelled(value_of(config, key))}"
            ]  # fmt: skip
    return shlex.join(map(clean, parts))


def commands_table(runs: list[Run]) -> Table | None:
    """One command a run, of every seed; None if no record tells."""
    each = [single for run in runs for single in run.repeats or (run,)]
    found = [(run, command) for run in each if (command := command_of(run)) is not None]
    if not found:
        return None
    several = len({run.facts.scene for run in runs}) > 1
    rows = [row([f"{run.facts.scene} {run.label}" if several else run.label, command]) for run, command in found]
    return Table("Commands", [Column("run", text=True), Column("made by", text=True, long=True, code=True)], rows)


def _scene(run: Run) -> str:
    """The scene as it was asked for, if the file beside the record says so; else its name."""
    path = run.directory / "config.toml"
    try:
        if path.is_file() and path.stat().st_size <= LARGEST_CONFIG:
            found = tomllib.loads(path.read_text(encoding="utf-8")).get("scene")
            if isinstance(found, str) and found:
                return found
    except (OSError, ValueError, RecursionError):
        pass  # the page is about the record
    return run.facts.scene


def value_of(config: dict[str, Any], key: str) -> object:
    """Value of a dotted key, in whichever block it stands."""
    for start in (*(config.get(block) for block in BLOCKS), config):
        value: object = start
        for name in key.split("."):
            value = value.get(name) if isinstance(value, dict) else None
        if value is not None:
            return value
    return None


def _spelled(value: object) -> str:
    return "none" if value is None else value if isinstance(value, str) else json.dumps(value, default=str)

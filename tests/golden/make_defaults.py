"""Write the defaults of every method of ours into defaults.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.training.identity import DEFAULTS, given_values
from splatwizard_core.training.keys import dotted
from splatwizard_core.training.params import OptimizationParams

FILE = Path(__file__).with_name("defaults.json")


def defaults(cls: type[OptimizationParams]) -> dict[str, Any]:
    """Return the default of every key, dotted, settings of what is named by default too."""
    return dotted(cls().completed(load_plugins(), {}).model_dump(mode="json"), "")


def counts(cls: type[OptimizationParams]) -> dict[str, int]:
    """Return how many changed defaults each block has counted, by its dotted key."""
    plugins = load_plugins()
    found: dict[str, int] = {}

    def collect(content: dict[str, Any], path: tuple[str, ...]) -> None:
        for name, value in content.items():
            if name == DEFAULTS:
                found.update({".".join(filter(None, (*path, key))): count for key, count in value.items()})
            elif isinstance(value, dict):
                collect(value, (*path, name))

    collect(given_values(cls().completed(plugins, {}), plugins), ())
    return found


def main() -> None:
    plugins = load_plugins()
    methods = sorted(entry.name for entry in plugins.methods if is_ours(entry.distribution))
    configs = {name: plugins.methods.load(name).Config for name in methods}
    kept = {name: {"values": defaults(cls), "counts": counts(cls)} for name, cls in configs.items()}
    FILE.write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()

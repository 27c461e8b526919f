"""Write the core's catalogue.json: kind -> name -> distribution, of everything that packages of this project register.

`superseded` in it names the distributions whose import paths a package brings besides its own.

    .venv/bin/python tools/make_catalogue.py

Run it where all packages of the workspace are installed, after a package gained, lost or renamed an entry.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import CORE, is_ours

ROOT = Path(__file__).resolve().parents[1]
CATALOGUE = ROOT / "splatwizard-core" / "src" / "splatwizard_core" / "plugins" / "catalogue.json"


def generate() -> str:
    """The text of the file. Raises SystemExit if a package of ours does not load: its entries would be lost."""
    plugins = load_plugins()
    broken = [f"{info.distribution}: {info.error}" for info in plugins.broken if is_ours(info.distribution)]
    if broken:
        raise SystemExit("cannot catalogue what does not load: " + "; ".join(broken))
    found = {
        kind: {
            name: e.distribution
            for e in registry
            if is_ours(e.distribution) and e.distribution != CORE
            for name in (e.name, *e.declared.get("aliases", ()))
        }
        for kind, registry in plugins.registries.items()
    }
    defaults = {kind: registry.default for kind, registry in plugins.registries.items()}
    brought = sorted(ROOT.glob("plugins/*/src/sw_*/__init__.py"))
    homes = {path.parent.name.replace("_", "-"): path.parents[2].name for path in brought}
    found["superseded"] = {name: home for name, home in homes.items() if name != home}
    found["default"] = {kind: found[kind][name] for kind, name in defaults.items() if name is not None}
    return json.dumps({kind: names for kind, names in found.items() if names}, indent=1, sort_keys=True) + "\n"


def main() -> int:
    """Write the file."""
    CATALOGUE.write_text(generate(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""`python -m sw_kit.checks.registration_child MODULE`: register a plugin in a fresh process and tell what it cost.

Prints one JSON object as its last line: CPU seconds of importing the module and calling its `register_*` hooks, and
whether torch came along. Whatever stands before that line the plugin has printed.
"""

from __future__ import annotations

import importlib
import json
import sys
import time

from splatwizard_core.api import Registry, hookimpl

MARK = f"{hookimpl.project_name}_impl"
"""Attribute by which pluggy knows an implementation."""


def register(module_name: str) -> None:
    """Import the module and call every hook that registers something."""
    module = importlib.import_module(module_name)
    for name, value in vars(module).items():
        options = getattr(value, MARK, None)
        hook = (options or {}).get("specname") or name
        if options is not None and hook.startswith("register_"):
            value(registry=Registry(hook))


def main(module_name: str) -> None:
    """Measure `register`."""
    before = set(sys.modules)
    began = time.process_time()
    register(module_name)
    seconds = time.process_time() - began
    found = {"cpu_s": seconds, "torch": "torch" in sys.modules, "modules": len(set(sys.modules) - before)}
    sys.stdout.flush()
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])

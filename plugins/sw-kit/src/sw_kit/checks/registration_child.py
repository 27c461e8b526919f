"""`python -m sw_kit.checks.registration_child MODULE`: register a plugin in a fresh process and tell what it cost.

Prints one JSON object as its last line: how many lines of Python importing the module and calling its `register_*`
hooks execute, and whether torch came along. Whatever stands before that line the plugin has printed.
"""

from __future__ import annotations

import importlib
import json
import sys
from types import FrameType
from typing import Any

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
    """Measure `register`: by lines, since a clock tells of the machine and its other work too."""
    lines = 0

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal lines
        lines += event == "line"
        return trace

    sys.settrace(trace)
    try:
        register(module_name)
    finally:
        sys.settrace(None)
    found = {"lines": lines, "torch": "torch" in sys.modules}
    sys.stdout.flush()
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])

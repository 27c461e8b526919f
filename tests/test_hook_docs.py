"""docs/plugins.md and the hook specifications stay together."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from splatwizard_core.plugins import hookspecs, load_plugins

DOCS = (Path(__file__).resolve().parents[1] / "docs" / "plugins.md").read_text()
HOOKS = {name: hook for name, hook in vars(hookspecs).items() if hasattr(hook, f"{hookspecs.PROJECT}_spec")}


def test_every_hook_has_its_heading_and_its_docstring_in_the_docs():
    for name, hook in HOOKS.items():
        (argument,) = inspect.signature(hook).parameters
        section = re.search(rf"^### `{name}\({argument}\)`\n(.*?)(?=^##|\Z)", DOCS, re.M | re.S)
        assert section, f"{name} has no heading in docs/plugins.md"
        assert " ".join(hook.__doc__.split()) in " ".join(section.group(1).split())


def test_the_docs_describe_no_hook_that_does_not_exist():
    assert set(re.findall(r"^### `(\w+)\(", DOCS, re.M)) == set(HOOKS)


def test_every_registering_hook_fills_a_registry():
    registering = {name for name in HOOKS if name.startswith("register_")}
    assert set(load_plugins()._filled_by) == registering
    assert set(HOOKS) - registering == {"describe_scene", "run_started", "run_finished"}

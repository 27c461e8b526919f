"""docs/plugins.md and the hook specifications stay together."""

from __future__ import annotations

import re
from pathlib import Path

from splatwizard_core.plugins import hookspecs
from splatwizard_core.plugins.manager import KINDS

DOCS = (Path(__file__).resolve().parents[1] / "docs" / "plugins.md").read_text()
HOOKS = sorted(name for name in vars(hookspecs) if name.startswith("register_"))


def test_every_hook_has_its_heading_and_its_docstring_in_the_docs():
    for name in HOOKS:
        section = re.search(rf"^### `{name}\((?:registry|cli)\)`\n(.*?)(?=^##|\Z)", DOCS, re.M | re.S)
        assert section, f"{name} has no heading in docs/plugins.md"
        assert " ".join(getattr(hookspecs, name).__doc__.split()) in " ".join(section.group(1).split())


def test_the_docs_describe_no_hook_that_does_not_exist():
    assert set(re.findall(r"^### `(\w+)\(", DOCS, re.M)) == set(HOOKS)


def test_every_hook_has_a_registry_or_is_the_command_hook():
    assert set(KINDS.values()) | {"register_commands"} == set(HOOKS)

"""docs/plugins.md taken apart: its sections, and its examples as the files of a package."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from splatwizard_core.plugins import hookspecs

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "plugins.md").read_text("utf-8")
PACKAGE = "sw_theirs"
LIBRARIES = ["sw-codecs", "sw-datasets", "sw-gaussians", "sw-reference"]
OTHERS = ["click>=8.1", "numpy>=1.26", "pillow>=10.3", "pydantic>=2.7", "torch>=2.4"]
REQUIRES = [*re.findall(r'^dependencies = \["(.*?)"\]', PAGE, re.M), *(f"{name}>=0.3" for name in LIBRARIES), *OTHERS]
HOOKS = {name for name, hook in vars(hookspecs).items() if hasattr(hook, f"{hookspecs.PROJECT}_spec")}


def sections() -> dict[str, str]:
    """Text by heading of the second and third level; of a hook its name, of others the heading."""
    found = {}
    for part in re.split(r"^###? (?=\S)", PAGE, flags=re.M)[1:]:
        title, _, text = part.partition("\n")
        found[title.strip("`").partition("(")[0]] = text
    return found


SECTIONS = sections()
BLOCKS = [
    (title, block)
    for title, text in SECTIONS.items()
    for block in re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)
]


def files_of(block: str) -> dict[str, str]:
    """Parts of a block by the module that its comments name; "" for what stands before the first of them."""
    parts = re.split(rf"^# {PACKAGE}/(\w+)\.py\n", block, flags=re.M)
    named = list(zip(parts[1::2], parts[2::2], strict=True))
    assert len(dict(named)) == len(named), "a block names a file twice"
    return {**({"": parts[0]} if parts[0].strip() else {}), **dict(named)}


def run(text: str) -> dict[str, Any]:
    """Execute lines of the page as a script, without the `annotations` of this file; returns what they define."""
    namespace: dict[str, Any] = {"__name__": "example"}
    exec(compile(text, "docs/plugins.md", "exec", dont_inherit=True), namespace)
    return namespace


def write_package(folder: Path) -> None:
    """Install the package of the examples into a folder: its modules, and what makes it a distribution."""
    modules: dict[str, str] = {"__init__": ""}
    for title, block in BLOCKS:
        for name, text in files_of(block).items():
            assert name in ("", "plugin") or name not in modules, f"{title} writes {name}.py again"
            modules[name] = modules.get(name, "") + text
    del modules[""]
    (folder / PACKAGE).mkdir()
    for name, text in modules.items():
        (folder / PACKAGE / f"{name}.py").write_text(text, "utf-8")
    info = folder / f"{PACKAGE}-0.1.dist-info"
    info.mkdir()
    requires = "".join(f"Requires-Dist: {each}\n" for each in REQUIRES)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: sw-theirs\nVersion: 0.1\n{requires}")
    (info / "entry_points.txt").write_text(f"[{hookspecs.ENTRY_POINT_GROUP}]\ntheirs = {PACKAGE}.plugin\n")

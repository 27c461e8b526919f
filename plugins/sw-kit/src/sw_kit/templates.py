"""The files of a new package: real files in the folder `templates`, with the author's names in place of `your-name`."""

from __future__ import annotations

import datetime
import functools
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sw_kit.names import Names

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parent / "templates"
SUFFIX = ".tmpl"
COMMON = "common"


@dataclass(frozen=True)
class Kind:
    """One kind of package: the table of `kinds.toml` that bears its name.

    registers       kind of the registry that it fills
    summary         what such a package is, in a sentence
    dependencies    requirements besides the core
    commands        lines that try the package
    """

    name: str
    registers: str
    summary: str
    dependencies: tuple[str, ...]
    commands: tuple[str, ...]


@functools.cache
def kinds() -> dict[str, Kind]:
    """Return every kind of package that can be written, by name."""
    tables = tomllib.loads((ROOT / "kinds.toml").read_text("utf-8"))
    return {
        name: Kind(name, table["registers"], table["summary"], tuple(table["dependencies"]), tuple(table["commands"]))
        for name, table in tables.items()
    }


def commands(kind: Kind, names: Names) -> list[str]:
    """Return the lines that try a new package once it is installed."""
    return [_named(line, names) for line in kind.commands]


def rendered(kind: Kind, names: Names) -> dict[str, str]:
    """Return the files of a new package: path below its folder -> text, sorted by path."""
    dependencies = "\n".join(f'  "{line}",' for line in kind.dependencies)
    words = {
        "your-summary": kind.summary,
        '  "your-dependencies",\n': f"{dependencies}\n" if dependencies else "",
        "your-commands": "\n".join(f"    {line}" for line in kind.commands),
        "your-year": str(datetime.date.today().year),
    }
    found = {}
    for folder in (COMMON, kind.name):
        for path, text in _templates(ROOT / folder):
            for word, value in words.items():
                text = text.replace(word, value)
            found[_named(path, names)] = _named(text, names)
    return dict(sorted(found.items()))


def _named(text: str, names: Names) -> str:
    return text.replace("your-name", names.key).replace("your_name", names.snake).replace("YourName", names.pascal)


def _templates(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield path below the folder, without the suffix, and text of every template."""
    for path in folder.rglob(f"*{SUFFIX}"):
        yield path.relative_to(folder).as_posix().removesuffix(SUFFIX), path.read_text("utf-8")

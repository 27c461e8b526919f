"""What the shell offers when TAB is pressed: names from the registries, scenes, paths. Imports nothing heavy.

Each function is handed to click as `shell_complete`: (context, parameter, what is typed so far) -> items.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem

from splatwizard_core.errors import SplatwizardError

if TYPE_CHECKING:
    from splatwizard_core.plugins import Entry

Complete = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]

VARIABLE = "_SW_COMPLETE"
"""The shell's script sets it to ask `sw` for completions."""
DATA = "SPLATWIZARD_DATA"  # the room that reads scenes has it too, and imports torch
# What every method has (design: presets `paper` and `quick`, the aliases of rate points).
COMMON_PRESETS = ("paper", "quick")
RATE_ALIASES = ("low", "default", "high", "all")
MOST = 500  # items; nobody reads more, and a folder may hold a hundred thousand


def files(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Files and folders, by the shell."""
    return [CompletionItem(incomplete, type="file")]


def folders(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Folders, by the shell."""
    return [CompletionItem(incomplete, type="dir")]


def names(kind: str) -> Complete:
    """Registered names of a kind; in a comma list, the one that is being typed."""

    def complete(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return _in_list(incomplete, [(entry.name, entry.summary) for entry in _registry(kind)])

    return complete


def rates(context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Rate points of the methods on the line, and the aliases."""
    found = _declared(context, "rates")
    return _in_list(incomplete, [(name, None) for name in [*found, *RATE_ALIASES]])


def presets(context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Presets of the methods on the line."""
    found = _declared(context, "presets") or list(COMMON_PRESETS)
    return _starting(incomplete, [(name, None) for name in found])


def scenes(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """`demo`, dataset/scene below $SPLATWIZARD_DATA, and folders by the shell."""
    found: list[tuple[str, str | None]] = [("demo", "procedural, made on the spot")]
    root = os.environ.get(DATA)
    if root:
        found += [(name, None) for name in _dataset_scenes(Path(root).expanduser())]
    return [CompletionItem(incomplete, type="dir"), *_starting(incomplete, found)]


def scene_or_file(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """What `sw info` takes."""
    return [CompletionItem(incomplete, type="file"), *scenes(context, parameter, incomplete)[1:]]


def image_folders(context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """The `images*` folders of the scene on the line."""
    scene = context.params.get("scene")
    if not isinstance(scene, str):
        return []
    root = os.environ.get(DATA)
    for place in (Path(scene).expanduser(), *((Path(root).expanduser() / scene,) if root else ())):
        if place.is_dir():
            return _starting(incomplete, [(p.name, None) for p in _folders_in(place) if p.name.startswith("images")])
    return []


def nothing(_context: click.Context, _parameter: click.Parameter, _incomplete: str) -> list[CompletionItem]:
    """For what only the user knows."""
    return []


def _registry(kind: str) -> Iterable[Entry]:
    from splatwizard_core.plugins import load_plugins

    try:
        return load_plugins().registries[kind]
    except SplatwizardError:  # $SW_PLUGINS names one that is not there: TAB is not the place to say so
        return []


def _declared(context: click.Context, what: str) -> list[str]:
    """What the registry entries of the methods on the command line declare, without importing them."""
    from splatwizard_core.cli.setup import DEFAULT_METHOD

    asked = context.params.get("methods") or context.params.get("method") or DEFAULT_METHOD
    words = [asked] if isinstance(asked, str) else asked
    methods = {name.strip() for word in words for name in word.split(",")}
    found = [value for entry in _registry("method") if entry.name in methods for value in entry.declared.get(what, ())]
    return list(dict.fromkeys(found))


def _dataset_scenes(root: Path) -> list[str]:
    return [f"{dataset.name}/{scene.name}" for dataset in _folders_in(root) for scene in _folders_in(dataset)][:MOST]


def _folders_in(path: Path) -> list[Path]:
    """Folders that are not hidden, sorted; empty where it cannot be listed."""
    with contextlib.suppress(OSError), os.scandir(path) as entries:
        return sorted(Path(e.path) for e in entries if e.is_dir() and not e.name.startswith("."))
    return []


def _in_list(incomplete: str, found: Iterable[tuple[str, str | None]]) -> list[CompletionItem]:
    """Completions of the last word of a comma list; words that stand in it already are not offered again."""
    before, comma, _ = incomplete.rpartition(",")
    taken = set(before.split(","))
    return _starting(incomplete, [(f"{before}{comma}{name}", about) for name, about in found if name not in taken])


def _starting(incomplete: str, found: Iterable[tuple[str, str | None]]) -> list[CompletionItem]:
    return [CompletionItem(name, help=about) for name, about in found if name.startswith(incomplete)][:MOST]

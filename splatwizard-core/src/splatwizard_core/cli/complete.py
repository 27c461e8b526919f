"""Completions for the shell's TAB: names from the registries, scenes, paths. Imports nothing heavy.

Each `complete_*` is handed to click as `shell_complete`: (context, parameter, the word so far) -> items.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping
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


def complete_files(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer files and folders, by the shell."""
    return [CompletionItem(incomplete, type="file")]


def complete_folders(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer folders, by the shell."""
    return [CompletionItem(incomplete, type="dir")]


def complete_nothing(_context: click.Context, _parameter: click.Parameter, _incomplete: str) -> list[CompletionItem]:
    """Offer nothing: only the user knows the value."""
    return []


def complete_names(kind: str) -> Complete:
    """Make a completion that offers the registered names of a kind; in a comma list, for its last word."""

    def complete(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return _in_list(incomplete, {entry.name: entry.summary for entry in _registered(kind)})

    return complete


def complete_rates(context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer the rate points of the methods on the line, and the aliases."""
    return _in_list(incomplete, dict.fromkeys([*_declared(context, "rates"), *RATE_ALIASES]))


def complete_presets(context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer the presets of the methods on the line."""
    return _starting(incomplete, dict.fromkeys(_declared(context, "presets") or COMMON_PRESETS))


def complete_scenes(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer the default scene, dataset/scene below $SPLATWIZARD_DATA, and folders by the shell."""
    found: dict[str, str | None] = {e.name: e.summary for e in _registered("dataset") if e.declared.get("default")}
    if root := os.environ.get(DATA):
        places = [(data, scene) for data in _folders_in(Path(root).expanduser()) for scene in _folders_in(data)]
        found |= {f"{data.name}/{scene.name}": None for data, scene in places[:MOST]}
    return [CompletionItem(incomplete, type="dir"), *_starting(incomplete, found)]


def complete_scene_or_file(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer scenes, and files by the shell."""
    return [CompletionItem(incomplete, type="file"), *complete_scenes(context, parameter, incomplete)[1:]]


def complete_image_folders(
    context: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Offer the `images*` folders of the scene on the line."""
    scene = context.params.get("scene")
    if not isinstance(scene, str):
        return []
    roots = [Path(root).expanduser() for root in (".", os.environ.get(DATA)) if root]
    places = [root / Path(scene).expanduser() for root in roots]
    names = next(([path.name for path in _folders_in(place)] for place in places if place.is_dir()), [])
    return _starting(incomplete, dict.fromkeys(name for name in names if name.startswith("images")))


def _registered(kind: str) -> Iterable[Entry]:
    from splatwizard_core.plugins import load_plugins

    try:
        return load_plugins().registries[kind]
    except SplatwizardError:  # $SW_PLUGINS names one that is not there: TAB is not the place to say so
        return []


def _declared(context: click.Context, field: str) -> list[str]:
    """Declared values of the methods on the command line, without importing them."""
    given = context.params.get("methods") or context.params.get("method") or ()
    named = {name.strip() for text in ([given] if isinstance(given, str) else given) for name in text.split(",")}
    chosen = [e for e in _registered("method") if (e.name in named if named else e.declared.get("default"))]
    return list(dict.fromkeys(value for entry in chosen for value in entry.declared.get(field, ())))


def _folders_in(path: Path) -> list[Path]:
    """Folders that are not hidden, sorted; empty where it cannot be listed."""
    with contextlib.suppress(OSError), os.scandir(path) as entries:
        return sorted(Path(e.path) for e in entries if e.is_dir() and not e.name.startswith("."))
    return []


def _in_list(incomplete: str, found: Mapping[str, str | None]) -> list[CompletionItem]:
    """Completions of the last word of a comma list; words that stand in it already are not offered again."""
    before, comma, _ = incomplete.rpartition(",")
    taken = set(before.split(","))
    return _starting(incomplete, {f"{before}{comma}{name}": found[name] for name in found if name not in taken})


def _starting(incomplete: str, found: Mapping[str, str | None]) -> list[CompletionItem]:
    """Completions among names, each with a line about it where there is one."""
    return [CompletionItem(name, help=found[name]) for name in found if name.startswith(incomplete)][:MOST]

"""Shell completion of `sw data`: names of data sets, and of their scenes."""

from __future__ import annotations

import click
from click.shell_completion import CompletionItem

from splatwizard_core.api import SplatwizardError


def datasets(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Known data sets; after a slash, the scenes of one."""
    from sw_datasets.downloads.registry import load_registry

    try:
        known = load_registry()
    except SplatwizardError:  # a registry of the user's own that cannot be read
        return []
    name, slash, _ = incomplete.partition("/")
    if slash:
        scenes = known[name].scenes if name in known else ()
        return [CompletionItem(f"{name}/{scene}") for scene in scenes if f"{name}/{scene}".startswith(incomplete)]
    return [CompletionItem(each, help=known[each].title) for each in known if each.startswith(incomplete)]


def dataset_or_folder(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Data sets, their scenes, and folders by the shell."""
    return [CompletionItem(incomplete, type="dir"), *datasets(context, parameter, incomplete)]

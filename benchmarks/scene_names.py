"""Scenes as the benchmarks take them: those of `sw --scene`, with a picture folder behind."""

from __future__ import annotations

from splatwizard_core.plugins import PluginManager
from splatwizard_core.scene.locate import is_procedural

FORMS = "FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES], or demo and its variants"


def split_scene(text: str, plugins: PluginManager) -> tuple[str, str]:
    """Split a scene into what --scene and --images take, "" for no picture folder.

    The word before the first colon is a family where one is called so, and else a folder; a scene that is made on the
    spot (demo:tiny) has no picture folders.
    """
    first, colon, rest = text.partition(":")
    if is_procedural(plugins.datasets, first):
        return text, ""
    if colon and first in plugins.datasets:
        folder, _, pictures = rest.partition(":")
        return f"{first}:{folder}", pictures
    return first, rest

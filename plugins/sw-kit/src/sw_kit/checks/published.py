"""Check of the published figures that a method's entry declares."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sw_report.published_files import published_by

from splatwizard_core.api import Method, UserInputError
from splatwizard_core.tooling import Choices
from sw_kit.finding import hold
from sw_kit.samples import TINY

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry


def check_published(entry: Entry, plugins: PluginManager) -> str:
    """Hold the file of figures to be readable, and its rate points, presets and values to be those of the method."""
    method: type[Method] = entry.load()
    try:
        figures = published_by(entry)
    except UserInputError as error:
        hold(False, str(error), "docs/plugins.md says what a published.toml holds")
    hold(figures, f"{entry.declared['published']} holds no figure", "leave out published=... until there is one")
    for figure in figures:
        whose = f"{figure.label} on {figure.dataset}/{figure.scene or 'mean'}"
        hold(
            figure.rate is None or figure.rate in method.RATES,
            f"{whose}: rate '{figure.rate}' is none of {', '.join(method.RATES)}",
            "name the rate point that is meant, or leave 'rate' out",
        )
        hold(
            figure.preset is None or (figure.preset in method.PRESETS and figure.scene is not None),
            f"{whose}: it cannot be run with preset '{figure.preset}'",
            f"'preset' is for figures of one scene, and one of {', '.join(method.PRESETS)}",
        )
        hold(
            figure.psnr is not None or figure.bytes is not None,
            f"{whose}: neither psnr nor bytes are given",
            "leave the figure out",
        )
        if figure.preset is not None:
            choices = Choices((entry.name,), TINY, rate=figure.rate, preset=figure.preset, sets=tuple(figure.sets))
            choices.resolve_one(plugins)  # raises for a wrong key or value
    told = sum(not figure.verified for figure in figures)
    return f"{len(figures)} figures" + (f", {told} of them second-hand" if told else "")

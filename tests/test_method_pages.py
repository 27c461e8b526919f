"""docs/methods has a page for each method, and its table holds every setting with default and description."""

from pathlib import Path

import pytest
from sw_gaussians.choices import Choice

from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.training.params import Params

PAGES = Path(__file__).parent.parent / "docs" / "methods"
OWN = [entry.name for entry in load_plugins().methods if is_ours(entry.distribution)]


def settings(block: Params, prefix: str = ""):
    """Key, value and description of every field; a block's defaults are those of the object that it defaults to.

    Settings of a chosen codec or pruner are those of the one that is chosen by default.
    """
    for name, field in type(block).model_fields.items():
        value = getattr(block, name)
        if isinstance(block, Choice) and name == "settings":
            model = getattr(block.provider(load_plugins(), prefix), "Settings", None)
            yield from settings(model(**value), f"{prefix}settings.") if model is not None else ()
        elif isinstance(value, Params):
            yield from settings(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value, field.description


@pytest.mark.parametrize("method", OWN)
def test_the_page_lists_every_setting_with_its_default(method):
    lines = (PAGES / f"{method}.md").read_text().splitlines()
    for key, default, description in settings(load_plugins().methods.load(method).Config()):
        shown = '""' if default == "" else default
        assert f"| `{key}` | {shown} | {description} |" in lines


@pytest.mark.parametrize("control", [e.name for e in load_plugins().density_controls if is_ours(e.distribution)])
def test_the_page_of_3dgs_lists_every_setting_of_every_density_control(control):
    lines = (PAGES / "3dgs.md").read_text().splitlines()
    for key, default, description in settings(load_plugins().density_controls.load(control).Settings()):
        assert f"| `density.settings.{key}` | {default} | {description} |" in lines


def test_all_methods_of_this_repository_are_looked_at():
    assert {path.stem for path in PAGES.glob("*.md")} == set(OWN)

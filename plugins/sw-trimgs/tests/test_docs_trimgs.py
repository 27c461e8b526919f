"""The README names every preset and rate point."""

from pathlib import Path

import pytest

from sw_trimgs.method import Flat3DGS, Trim3DGS
from sw_trimgs.surfel_method import Trim2DGS, Trim2DGSScratch

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.parametrize("method", [Flat3DGS, Trim3DGS, Trim2DGS, Trim2DGSScratch])
def test_the_readme_names_methods_presets_and_rate_points(method):
    text = README.read_text()
    for name in (method.name, *method.PRESETS, *method.RATES):
        assert f"`{name}`" in text, name


def test_what_the_plugin_declares_is_what_the_methods_have(plugins):
    for method in (Flat3DGS, Trim3DGS, Trim2DGS, Trim2DGSScratch):
        declared = plugins.methods.entry(method.name).declared
        assert list(declared["presets"]) == list(method.PRESETS)
        assert list(declared["rates"]) == list(method.RATES)

"""The two faces of the core: few names, lazy, typed, and each of them documented."""

from __future__ import annotations

import re

import pytest
import torch
from counted_lines import lines_of_process
from import_graph import CORE, ROOT
from torch import nn

from splatwizard_core import api, tooling

PAGE = (ROOT / "docs" / "plugins.md").read_text("utf-8")
MOST_NAMES = 80


@pytest.mark.parametrize("face", [api, tooling], ids=["api", "tooling"])
def test_every_name_leads_to_what_its_module_has(face):
    for name in face.__all__:
        assert getattr(face, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = face.no_such_name


@pytest.mark.parametrize("face", [api, tooling], ids=["api", "tooling"])
def test_the_stub_lists_nothing_else(face):
    stub = (CORE / f"{face.__name__.rpartition('.')[2]}.pyi").read_text("utf-8")
    assert set(re.findall(r"^from splatwizard_\S+ import (\w+) as \1$", stub, re.M)) == set(face.__all__)
    assert len(face.__all__) == len(stub.splitlines())


@pytest.mark.parametrize("name", ["origin_of", "world_shift"])
def test_a_name_of_an_older_release_is_found_with_a_warning_and_not_listed(name):
    vars(api).pop(name, None)  # kept there once it was asked for
    with pytest.warns(DeprecationWarning, match=rf"splatwizard_core\.api\.{name} goes with 0\.4"):
        found = getattr(api, name)
    assert found(nn.Module()) is None  # a model of another kind says nothing of the world
    assert name not in api.__all__


def test_the_older_name_of_a_colours_coefficient_works():
    vars(api).pop("rgb_to_dc", None)
    with pytest.warns(DeprecationWarning, match="goes with 0.4"):
        assert api.rgb_to_dc(torch.tensor(0.5)) == 0


def test_the_api_is_small():
    assert len(api.__all__) == len(set(api.__all__)) <= MOST_NAMES


@pytest.mark.parametrize(("face", "title"), [(api, "The API"), (tooling, "For packages about runs")])
def test_every_name_is_documented(face, title):
    section = re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S)
    assert section is not None
    assert set(re.findall(r"^\| `(\w+)` \|", section.group(1), re.M)) == set(face.__all__)


def test_importing_the_api_is_quick():
    """It imports none of the large libraries, and executes 13,000 lines; pydantic would take many times that."""
    lines, modules = lines_of_process("import splatwizard_core.api")
    assert {"torch", "numpy", "scipy", "pydantic", "PIL"}.isdisjoint(modules)
    assert lines < 30_000

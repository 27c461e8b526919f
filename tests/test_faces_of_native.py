"""The types of native operations are those of their headers."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "tools"))

import make_faces


@pytest.mark.parametrize("path", make_faces.faces(), ids=make_faces.module_of)
def test_the_types_of_operations_are_those_of_the_header(path):
    assert path.with_suffix(".pyi").read_text() == make_faces.stub(path), "run tools/make_faces.py"

"""Damage to coded bytes, and the exact mode with and without its compiled kernels."""

from types import SimpleNamespace

import pytest

from sw_codecs import exact_native
from sw_codecs.context import integer_mlp
from sw_codecs.context.fast import integer_grid
from sw_codecs.entropy import conditional, exact_streams, lattice
from sw_codecs.exact_native import EXACT
from sw_codecs.testing import check_damage


@pytest.fixture
def assert_survives_damage():
    return check_damage


@pytest.fixture
def kernels(monkeypatch):
    """Let the exact mode run with its compiled kernels or without: `kernels(False)`."""
    users = (integer_grid, integer_mlp, conditional, exact_streams, lattice, exact_native)

    def use(compiled):
        if compiled:
            EXACT.load()
        without = SimpleNamespace(try_load=lambda: False, load_built=lambda: False)
        for module in users:
            monkeypatch.setattr(module, "EXACT", EXACT if compiled else without)

    return use

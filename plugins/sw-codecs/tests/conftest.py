"""A decoder of bytes that are cut anywhere or changed at any byte raises BitstreamError or still decodes right."""

from types import SimpleNamespace

import numpy as np
import pytest

from splatwizard_core.errors import BitstreamError
from sw_codecs import exact_native
from sw_codecs.context import hash_grid, integer_mlp, plane_streams, triplane
from sw_codecs.entropy import conditional, exact_streams, lattice
from sw_codecs.exact_native import EXACT


def _assert_survives_damage(data, decode, expected, *, masks=(0x01, 0x80, 0xFF), truncations=None):
    """decode(bytes) -> array. Every truncation is refused; a flipped byte is refused or harmless."""
    for length in truncations if truncations is not None else range(len(data)):
        with pytest.raises(BitstreamError):
            decode(data[:length])
    with pytest.raises(BitstreamError):
        decode(data + b"\x00")
    for i in range(len(data)):
        for mask in masks:
            changed = bytearray(data)
            changed[i] ^= mask
            try:
                found = decode(bytes(changed))
            except BitstreamError:
                continue
            assert np.array_equal(found, expected), f"byte {i} ^ {mask:#x} decodes to something else"


@pytest.fixture
def assert_survives_damage():
    return _assert_survives_damage


@pytest.fixture
def kernels(monkeypatch):
    """Let the exact mode run with its compiled kernels or without: `kernels(False)`."""
    users = (hash_grid, integer_mlp, plane_streams, triplane, conditional, exact_streams, lattice, exact_native)

    def use(compiled):
        if compiled:
            EXACT.load()
        without = SimpleNamespace(try_load=lambda: False, load_built=lambda: False)
        for module in users:
            monkeypatch.setattr(module, "EXACT", EXACT if compiled else without)

    return use

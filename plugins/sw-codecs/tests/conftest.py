"""A decoder of bytes that are cut anywhere or changed at any byte raises BitstreamError or still decodes right."""

import numpy as np
import pytest

from splatwizard_core.errors import BitstreamError


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

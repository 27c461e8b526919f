import numpy as np
import pytest

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader
from sw_wisp.nested import UNIT
from sw_wisp.static import StaticContext


def drawn(n: int = 30_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Levels, and values in 1/4096 base steps whose means and spreads follow them."""
    rng = np.random.default_rng(seed)
    levels = rng.integers(7, 11, n)
    return levels, UNIT * rng.normal(levels[:, None] - 9, 0.2 * levels[:, None], (n, 22))


def test_statistics_return():
    context = StaticContext.fitted(*drawn())
    reader = ByteReader(context.pack())
    again = StaticContext.unpack(reader)
    reader.finish()
    for name in ("row", "means", "tables", "multipliers"):
        assert np.array_equal(getattr(again, name), getattr(context, name))


def test_rare_levels_take_the_statistics_of_the_nearest():
    levels, units = drawn()
    levels[:3] = [3, 12, 18]
    context = StaticContext.fitted(levels, units)
    assert context.row[[0, 4, 5, 6, 7, 9, 15]].tolist() == [0, 0, 1, 2, 3, 3, 3]


def test_damaged_statistics_are_refused():
    data = bytearray(StaticContext.fitted(*drawn(500)).pack())
    for place, value in [(0, 0), (3, 200), (len(data) - 1, 64)]:
        damaged = bytearray(data)
        damaged[place] = value
        with pytest.raises(BitstreamError):
            StaticContext.unpack(ByteReader(damaged))

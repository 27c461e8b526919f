"""The shipped integers: right by an independent library, reproducible by the script, damage found."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from splatwizard_core.errors import BitstreamError
from sw_codecs.entropy import exact_tables as module
from sw_codecs.entropy.exact_tables import FRACTIONS, LEVELS, exact_tables, parse

PACKAGE = Path(__file__).parents[2]
FILE = PACKAGE / "src/sw_codecs/data/exact_tables.bin"
CRC_OF_VERSION_1 = 0x80D0222E


@pytest.fixture
def script():
    pytest.importorskip("mpmath", reason="the script needs mpmath")
    return runpy.run_path(str(PACKAGE / "tools/make_exact_tables.py"))


@pytest.mark.slow
def test_the_script_makes_the_shipped_file(script, tmp_path):
    script["main"](tmp_path / "tables.bin")
    assert (tmp_path / "tables.bin").read_bytes() == FILE.read_bytes()


@pytest.mark.parametrize("family", ["gaussian", "laplace"])
def test_the_script_makes_the_shipped_counts(script, family):
    """Of every seventh table up to scales of 8 steps; the whole file takes seconds."""
    tables, ratio = getattr(exact_tables(), family).counts, script["SCALE_HIGH"] / script["SCALE_LOW"]
    for number in range(0, 45 * FRACTIONS, 7):
        level, fraction = divmod(number, FRACTIONS)
        scale = script["SCALE_LOW"] * ratio ** (script["mpmath"].mpf(level) / (LEVELS - 1))
        assert script["count_table"](family, scale, fraction) == list(tables[number]), number


def test_the_shipped_file_is_version_1_for_ever():
    # Files in the world name this CRC; a change of contents needs a new version beside it.
    assert (exact_tables().version, exact_tables().crc) == (1, CRC_OF_VERSION_1)


def test_any_flipped_byte_of_the_file_is_found():
    data = FILE.read_bytes()
    for i in [*range(12), len(data) // 2, len(data) - 1]:
        changed = bytearray(data)
        changed[i] ^= 4
        with pytest.raises(BitstreamError, match="exact tables"):
            parse(bytes(changed))
    for length in (0, 5, 9, len(data) - 1):
        with pytest.raises(BitstreamError, match="exact tables"):
            parse(data[:length])


def test_steps_scales_and_thresholds():
    tables = exact_tables()
    t = -8 + (np.arange(128) + 0.5) / 8
    assert np.abs(tables.multipliers - np.maximum(64, 4096 * (1 + np.tanh(t)))).max() <= 0.5 + 1e-9
    scales = 0.05 * (64 / 0.05) ** (np.arange(LEVELS) / 63)
    np.testing.assert_allclose(tables.scales, scales, atol=2**-21 + 1e-12)
    assert np.abs(tables.thresholds - 4096 * np.sqrt(scales[1:] * scales[:-1])).max() <= 0.5 + 1e-9
    assert (np.diff(tables.thresholds) > 0).all()


def test_the_gaussian_tables_hold_as_many_counts_as_the_specification_says():
    assert sum(map(len, exact_tables().gaussian.counts)) == 59_776


@pytest.mark.parametrize(("family", "radius"), [("gaussian", 6), ("laplace", 10)])
def test_counts_are_those_of_scipy(family, radius):
    found = getattr(exact_tables(), family)
    assert len(found.counts) == LEVELS * FRACTIONS
    for number in range(0, LEVELS * FRACTIONS, 7):
        level, fraction = divmod(number, FRACTIONS)
        scale = 0.05 * (64 / 0.05) ** (level / 63)
        reach = int(np.ceil(radius * scale)) + 1
        assert found.radius[level] == reach
        density = (stats.norm if family == "gaussian" else stats.laplace)(loc=(fraction - 4) / 8, scale=scale)
        s = np.arange(-reach, reach + 1)
        # Whichever tail is small keeps its digits.
        mass = np.where(s > 0, density.sf(s - 0.5) - density.sf(s + 0.5), density.cdf(s + 0.5) - density.cdf(s - 0.5))
        escape = density.cdf(-reach - 0.5) + density.sf(reach + 0.5) + 2.0**-16
        exact = np.append(mass, escape) * 65536
        counts = found.counts[number]
        # Rounded to nearest, but never to 0; 1e-6 for the float arithmetic on this side.
        assert (np.abs(counts - np.maximum(exact, 1)) <= 0.5 + 1e-6).all()


def test_a_file_that_names_other_tables_is_refused():
    tables = exact_tables()
    tables.check(tables.version, tables.crc)
    with pytest.raises(BitstreamError, match="install the sw-codecs version"):
        tables.check(tables.version, tables.crc ^ 1)
    with pytest.raises(BitstreamError, match="install the sw-codecs version"):
        tables.check(tables.version + 1, tables.crc)
    assert module.exact_tables() is tables

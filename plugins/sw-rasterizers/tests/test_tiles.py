"""Tile coverage of random ellipses equals brute force."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

import sw_rasterizers
from splatwizard_native import CompilerMissingError, find_compiler


def test_tiles_of_ten_thousand_ellipses_equal_brute_force(tmp_path):
    try:
        compiler = find_compiler()
    except CompilerMissingError as error:
        pytest.skip(str(error))
    headers = Path(sw_rasterizers.__file__).parent / "csrc"
    source, program = Path(__file__).with_name("tiles_check.cpp"), tmp_path / "tiles_check"
    subprocess.run([*compiler, "-std=c++20", "-O1", f"-I{headers}", str(source), "-o", str(program)], check=True)
    printed = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    cases, missed, excess, total = map(int, printed.split())
    assert cases == 10_000
    assert total > 30_000
    assert missed == 0
    assert excess == 0

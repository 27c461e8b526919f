"""The public names of the package."""

from __future__ import annotations

import subprocess
import sys

import pytest

import splatwizard_native


@pytest.mark.parametrize("name", splatwizard_native.__all__)
def test_each_name_is_there(name: str):
    assert getattr(splatwizard_native, name) is not None


def test_importing_the_package_imports_no_torch():
    program = "import sys, splatwizard_native; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0

"""The public names of the package."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import splatwizard_native


@pytest.mark.parametrize("name", splatwizard_native.__all__)
def test_each_name_is_there_and_type_checkers_see_it(name: str):
    assert getattr(splatwizard_native, name) is not None
    source = Path(splatwizard_native.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    assert re.search(rf"import {name} as {name}$", source, re.MULTILINE)


def test_importing_the_package_imports_no_torch():
    program = "import sys, splatwizard_native; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0

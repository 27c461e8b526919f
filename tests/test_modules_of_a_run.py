"""A run compiles the native modules that it uses, and no others: those of `make demo` are counted."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from forked_children import run_python

GOLDEN = Path(__file__).parent / "golden"
pytestmark = pytest.mark.pipeline

STUB = """#!/bin/sh
for word in "$@"; do case "$word" in --version|-dumpversion|-dumpmachine) echo "stub 14.0"; exit 0;; esac; done
echo "$@" >> "$TEST_ASKED_FOR"
echo "this compiler only counts" >&2
exit 1
"""


def compiled_by(tmp_path: Path, *words: str) -> set[str]:
    """Return the packages whose native sources a command wants to compile, with the processes that it starts.

    There is no build to be found, and the compiler compiles nothing: everything is computed with torch instead.
    """
    compiler, asked_for = tmp_path / "g++", tmp_path / "asked.txt"
    compiler.write_text(STUB)
    compiler.chmod(0o755)
    asked_for.touch()
    beside = {"CXX": str(compiler), "TEST_ASKED_FOR": str(asked_for), "SPLATWIZARD_CACHE": str(tmp_path / "cache")}
    done = run_python("-m", "splatwizard_core", *words, env={**os.environ, **beside})
    assert done.returncode == 0, done.stderr[-2000:]
    return set(re.findall(r"/src/(\w+)/\S+\.cpp", asked_for.read_text()))


def test_a_run_of_chimerags_which_trains_3dgs_first_compiles_nothing_of_anchors(tmp_path: Path):
    run = ["--method", "chimerags", "--scene", "demo:tiny", "--device", "cpu", "--out", str(tmp_path / "out")]
    sets = {"iterations": 3, "scale_schedule": "true", "pretrained.iterations": 3, "threads": 1}
    short = [word for key, value in sets.items() for word in ("--set", f"{key}={value}")]
    # sw_codecs: where vectors are many enough for its kernel, as they are on the whole demo scene
    assert compiled_by(tmp_path, "run", *run, *short) - {"sw_codecs"} == {"splatwizard_native", "sw_rasterizers"}


def test_decoding_a_file_of_3dgs_compiles_nothing(tmp_path: Path):
    assert compiled_by(tmp_path, "decode", str(GOLDEN / "3dgs_r3_v1.swz"), "--device", "cpu") == set()

"""One C++ runtime in the process, whatever the compiler brings: modules format numbers and let errors pass."""

from __future__ import annotations

import shutil
import sys

import pytest
from forked_children import run_python

from splatwizard_native import toolchain

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="the loader of Linux"),
    pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ on this machine"),
]

# The text of a refusal, and a throw through a frame with something to clean up.
SOURCE = """
#include <sstream>
#include <stdexcept>
#include <string>
extern "C" int digits() { std::ostringstream text; text << 1234; return int(text.str().size()); }
extern "C" int refused(int n) {
  try {
    std::string kept = "a text that is too long to lie in the string itself: " + std::to_string(n);
    if (n > 0) throw std::invalid_argument(kept);
  } catch (const std::exception&) {
    return 1;
  }
  return 0;
}
"""
CALL = """
import ctypes, sys
import torch
module = ctypes.CDLL(sys.argv[1])
print(module.digits(), module.refused(3))
"""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """The source as an object, whose runtime is chosen when it is linked."""
    folder = tmp_path_factory.mktemp("digits")
    (folder / "digits.cpp").write_text(SOURCE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CXX", "g++")
        job = toolchain.Job(folder / "digits.cpp", folder / "digits.o", ("-O3", "-fPIC"))
        toolchain.Toolchain(1).compile([job], folder / "log")
    return folder / "digits.o"


@pytest.mark.parametrize("flags", ["", " -static-libgcc -static-libstdc++"], ids=["shared", "static"])
def test_a_module_runs_on_the_runtime_of_torch(flags, compiled, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", f"g++{flags}")
    made = tmp_path / "digits.so"
    toolchain.Toolchain(1).link([compiled], made, tmp_path / "log", toolchain.libraries("native", tmp_path))
    done = run_python("-c", CALL, str(made))
    assert (done.returncode, done.stdout.split()) == (0, ["4", "1"]), done.stderr


def test_both_libraries_are_found_in_this_process():
    import torch

    assert torch.__version__
    names = [path.rpartition("/")[2].partition(".")[0] for path in toolchain.runtime_libraries()]
    assert names == ["libgcc_s", "libstdc++"]

"""One C++ runtime in the process, whatever the compiler brings: modules format numbers and let errors pass."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from splatwizard_native import toolchain

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="the loader of Linux"),
    pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ on this machine"),
]

# The message of a failed check, and a throw from torch's runtime through a frame with something to clean up.
SOURCE = """
#include <sstream>
#include <string>
#include <c10/util/Exception.h>
extern "C" int digits() { std::ostringstream text; text << 1234; return int(text.str().size()); }
extern "C" int refused(int n) {
  try {
    std::string kept = "a text that is too long to lie in the string itself: " + std::to_string(n);
    TORCH_CHECK(n < 0, kept);
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


@pytest.mark.parametrize("flags", ["", " -static-libgcc -static-libstdc++"], ids=["shared", "static"])
def test_a_module_runs_on_the_runtime_of_torch(flags, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", f"g++{flags}")
    tools = toolchain.Toolchain(1)
    source, made, log = tmp_path / "digits.cpp", tmp_path / "digits.so", tmp_path / "log"
    source.write_text(SOURCE, encoding="utf-8")
    include = toolchain.torch_include_flags()
    tools.compile([toolchain.Job(source, tmp_path / "digits.o", (*toolchain.common_flags(), *include))], log)
    tools.link([tmp_path / "digits.o"], made, log, toolchain.torch_libraries(cuda=False))
    done = subprocess.run([sys.executable, "-c", CALL, str(made)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, ["4", "1"]), done.stderr


def test_both_libraries_are_found_in_this_process():
    import torch

    assert torch.__version__
    names = [path.rpartition("/")[2].partition(".")[0] for path in toolchain.runtime_libraries()]
    assert names == ["libgcc_s", "libstdc++"]

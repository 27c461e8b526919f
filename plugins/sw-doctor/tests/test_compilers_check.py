"""The compilers that `sw doctor` finds: one that works, none, one that is broken, one that does not fit torch."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from doctored import script
from sw_doctor import compilers

from splatwizard_native import toolchain

needs_compiler = pytest.mark.skipif(
    not any(shutil.which(name) for name in toolchain.COMPILERS), reason="no C++ compiler on this machine"
)


@needs_compiler
def test_a_compiler_that_works_is_ok_by_its_own_name(monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    found = compilers.check_cxx()
    assert (found.state, found.mend) == ("ok", None)
    assert any(name in found.detail.lower() for name in ("g++", "clang", "gcc", "c++"))


def test_without_a_compiler_the_line_installs_one(bare):
    script(bare / "apt-get", "exit 0")
    found = compilers.check_cxx()
    assert (found.state, found.mend) == ("missing", "sudo apt install g++")


@pytest.mark.skipif(sys.platform == "darwin", reason="macOS has its own line")
def test_where_there_is_no_package_manager_that_it_knows_the_line_is_a_sentence(bare):
    assert compilers.how_to_get_a_compiler().startswith("install g++ or clang++")
    script(bare / "dnf", "exit 0")
    assert compilers.how_to_get_a_compiler() == "sudo dnf install gcc-c++"


def test_a_compiler_that_does_not_compile_is_broken_in_its_own_words(bare):
    script(bare / "g++", "echo 'doctor.cpp:1:10: fatal error: span: No such file or directory' >&2", "exit 1")
    found = compilers.check_cxx()
    assert found.state == "broken"
    assert "fatal error: span: No such file or directory" in found.detail
    assert found.mend is not None


def test_a_compiler_that_writes_nothing_is_broken_though_it_says_0(bare):
    script(bare / "g++", "exit 0")
    assert compilers.check_cxx().state == "broken"


def test_a_compiler_without_openmp_is_told_how_to_get_it(bare):
    script(bare / "clang++", 'echo "ld: error: cannot find -lomp" >&2', "exit 1")
    assert "libomp" in (compilers.check_cxx().mend or "")


@pytest.mark.parametrize("value", ["no-such-compiler", "'unclosed"])
def test_cxx_that_names_nothing_is_broken_and_can_be_unset(bare, monkeypatch, value):
    monkeypatch.setenv("CXX", value)
    found = compilers.check_cxx()
    assert found.state == "broken"
    assert "CXX" in found.detail
    assert found.mend == "unset CXX, or set it to a compiler"


@pytest.fixture
def cuda_build(monkeypatch):
    monkeypatch.setattr(compilers.importlib.metadata, "version", lambda name: "2.13.0+cu130")


def nvcc(folder: Path, release: str, status: int = 0) -> None:
    script(
        folder / "nvcc",
        f'if [ "$1" = --version ]; then echo "Cuda compilation tools, release {release}, V{release}.1"; exit 0; fi',
        'for last; do :; done; : > "$last"',
        f"test {status} = 0 || echo 'error: unsupported GNU version!' >&2",
        f"exit {status}",
    )


def test_nvcc_is_judged_by_the_cuda_of_torch(bare, cuda_build):
    nvcc(bare, "13.0")
    found = compilers.check_nvcc()
    assert (found.state, found.facts["release"]) == ("ok", "13.0")
    assert compilers.judge_nvcc(found, "13.1").state == "ok"  # one major release
    other = compilers.judge_nvcc(found, "12.8")
    assert other.state == "broken"
    assert "13.0" in other.detail
    assert "12.8" in other.detail
    assert other.mend is not None
    assert "cuda-toolkit-12-8" in other.mend
    assert "of no use" in compilers.judge_nvcc(found, None).detail


def test_an_nvcc_that_compiles_nothing_is_broken(bare, cuda_build):
    nvcc(bare, "13.0", status=1)
    script(bare / "g++", "exit 0")
    found = compilers.check_nvcc()
    assert found.state == "broken"
    assert "unsupported GNU version" in found.detail
    assert "CUDA toolkit again" in (found.mend or "")
    assert compilers.judge_nvcc(found, "13.0") == found
    (bare / "g++").unlink()  # what nvcc asks for first
    assert compilers.check_nvcc().mend == compilers.how_to_get_a_compiler()


def test_an_nvcc_is_not_tried_beside_a_torch_for_cpus(bare, monkeypatch):
    monkeypatch.setattr(compilers.importlib.metadata, "version", lambda name: "2.13.0+cpu")
    nvcc(bare, "13.0", status=1)
    found = compilers.judge_nvcc(compilers.check_nvcc(), None)
    assert found.state == "ok"
    assert "not tried" in found.detail


@pytest.mark.skipif(Path("/usr/local/cuda/bin/nvcc").is_file(), reason="this machine has one at its usual place")
def test_a_missing_nvcc_matters_only_to_a_torch_with_cuda(bare):
    found = compilers.check_nvcc()
    assert found.state == "missing"
    assert compilers.judge_nvcc(found, None).mend is None
    assert "cuda-toolkit-13-0" in (compilers.judge_nvcc(found, "13.0").mend or "")

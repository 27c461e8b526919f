"""The whole page of `sw doctor`: which line mends what, what decides, how long a line is."""

from __future__ import annotations

from sw_doctor import diagnosis
from sw_doctor.compilers import judge_nvcc
from sw_doctor.text import gigabytes, one_line

from splatwizard_core.plugins.check import Check

NVCC = Check("compilers", "nvcc", "ok", "CUDA 13.0")


def test_what_waits_for_a_compiler_is_mended_by_the_line_of_the_compiler():
    job = Check("main job", "sw run", "ok", "", None, True, {"device": "cpu", "compiled_first": ["standard"]})
    unbuilt = Check("kernels", "k", "missing", "not built", "sw build-kernels")
    obstacle = Check("compilers", "C++", "missing", "none", "sudo apt install g++")
    assert diagnosis._without_builds(unbuilt, obstacle, NVCC).mend == "sudo apt install g++"
    slow = diagnosis._without_builds(job, obstacle, NVCC)
    assert slow.mend == "sudo apt install g++"
    assert "slowly" in slow.detail
    assert slow.state == "ok"


def test_kernels_of_cuda_are_mended_by_the_line_of_the_toolkit_that_fits_torch():
    found = Check("compilers", "nvcc", "ok", "CUDA 13.0", facts={"release": "13.0", "path": "/opt/nvcc"})
    nvcc, obstacle = judge_nvcc(found, "12.8"), Check("compilers", "C++", "missing", "none", "sudo apt install g++")
    kernels = {
        target: Check("kernels", target, "missing", "not built", "sw build-kernels", facts={"target": target})
        for target in ("cpu", "cuda")
    }
    for each, cpu in ((None, "sw build-kernels"), (obstacle, "sudo apt install g++")):
        mends = {name: diagnosis._without_builds(check, each, nvcc).mend for name, check in kernels.items()}
        assert mends == {"cpu": cpu, "cuda": nvcc.mend}
    assert nvcc.mend == "install the CUDA toolkit 12.8: sudo apt install cuda-toolkit-12-8"


def test_only_needed_checks_decide(monkeypatch):
    fine, optional = Check("g", "a", "ok", "", needed=True), Check("g", "b", "broken", "")
    assert diagnosis.Diagnosis([fine, optional], 1.0).ok
    assert not diagnosis.Diagnosis([fine, Check("g", "c", "missing", "", needed=True)], 1.0).ok


def test_strangers_text_becomes_one_line_of_bounded_length():
    assert one_line("a\n\n  b") == "a b"
    assert len(one_line("x" * 9999)) < 400
    assert gigabytes(1.5e9) == "1.50 GB"
    assert gigabytes(25.3e9) == "25 GB"

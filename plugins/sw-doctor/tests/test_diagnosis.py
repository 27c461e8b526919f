"""The whole page of `sw doctor`: which line mends what, what decides, how long a line is."""

from __future__ import annotations

from sw_doctor import diagnosis
from sw_doctor.text import gigabytes, one_line

from splatwizard_core.plugins.check import Check


def test_what_waits_for_a_compiler_is_mended_by_the_line_of_the_compiler():
    job = Check("main job", "sw run", "ok", "", None, True, {"device": "cpu", "compiled_first": ["standard"]})
    unbuilt = Check("kernels", "k", "missing", "not built", "sw build-kernels")
    obstacle = Check("compilers", "C++", "missing", "none", "sudo apt install g++")
    assert diagnosis._without_builds(unbuilt, obstacle).mend == "sudo apt install g++"
    slow = diagnosis._without_builds(job, obstacle)
    assert slow.mend == "sudo apt install g++"
    assert "slowly" in slow.detail
    assert slow.state == "ok"


def test_only_needed_checks_decide(monkeypatch):
    fine, optional = Check("g", "a", "ok", "", needed=True), Check("g", "b", "broken", "")
    assert diagnosis.Diagnosis([fine, optional], 1.0).ok
    assert not diagnosis.Diagnosis([fine, Check("g", "c", "missing", "", needed=True)], 1.0).ok


def test_strangers_text_becomes_one_line_of_bounded_length():
    assert one_line("a\n\n  b") == "a b"
    assert len(one_line("x" * 9999)) < 400
    assert gigabytes(1.5e9) == "1.50 GB"
    assert gigabytes(25.3e9) == "25 GB"

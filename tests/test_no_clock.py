"""No default test reads a clock, compares measured seconds, or gives a process less than a minute.

What is measured differs from machine to machine and with the other work on it. Counts of lines, calls or bytes stand
for time (tests/counted_lines.py), or a clock that the test moves; a comparison of clocks is marked `slow`, or a script
in benchmarks/.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from import_graph import ROOT

CLOCKS = {
    f"{name}{unit}" for name in ("perf_counter", "monotonic", "process_time", "thread_time") for unit in ("", "_ns")
} | {"default_timer", "timeit"}
CPU_TIMES = {"ru_utime", "ru_stime"}  # of getrusage, which tells memory too
IN_TEXT = re.compile(rf"\b(?:(?:{'|'.join(sorted(CLOCKS))}|time\.time(?:_ns)?)(?=\()|{'|'.join(sorted(CPU_TIMES))})")
MEASURED = re.compile(r"(?:.*_s|.*seconds|.*fps|.*latency\w*|elapsed|took|taken)")
LEAST_TIMEOUT = 60
NOT_DEFAULT = ("slow", "cuda", "fuzz")

ALLOWED = {
    "tests/headless_chromium.py": "drives a browser for slow tests: its clock ends one that hangs",
    "splatwizard-core/tests/evaluation/test_speed.py::SleepingRenderer": "of two slow tests",
    "splatwizard-core/tests/evaluation/test_speed.py::test_repeats_are_measured_after_one_warm_up_and_give_the_spread":
        "its clock is the renderer's",
    "plugins/sw-doctor/tests/test_child_processes.py::test_a_process_that_dies_or_hangs_is_a_finding":
        "the clock that the limit is held against stands still until the process hangs",
    "splatwizard-core/tests/runs/test_survival.py::undisturbed": "the slow tests kill a run at parts of its time",
    "splatwizard-core/tests/base/test_files.py::test_temporaries_of_another_container_stay_for_a_day":
        "gives a file an age of two days",
    "splatwizard-native/tests/test_waiting.py::SPIN": "of a slow test",
    "splatwizard-native/tests/test_build_lock.py": "locks of one process, free or held: a limit of 0 s is the same",
    "tests/forked_children.py::Forked": "a limit of 0 s asks without waiting",
    "tests/test_forked_children.py::test_it_is_started_stopped_and_killed_as_any_process":
        "the child waits for input that never comes",
    "splatwizard-core/tests/runs/test_measuring.py::test_repeats_leave_their_spread_in_the_record":
        "a mean lies between the least and the most of its own values",
    "splatwizard-core/tests/runs/test_measuring.py::test_loading_and_compiling_are_told_apart":
        "loading is measured around preparing",
}  # fmt: skip
"""FILE, or FILE::FUNCTION, CLASS or VARIABLE: why what stands there cannot fail by the clock."""


def files_of_tests() -> list[Path]:
    folders = [ROOT / "tests", *ROOT.glob("splatwizard-*/tests"), *ROOT.glob("plugins/*/tests")]
    folders += [*ROOT.glob("examples/*/tests"), *ROOT.glob("plugins/sw-kit/src/sw_kit/templates/*/tests")]
    return sorted(path for folder in folders for path in folder.rglob("*.py") if path != Path(__file__))


def whole_mark(node: ast.expr) -> bool:
    """Whether a decorator, or the value of `pytestmark`, takes what it marks out of the default tests."""
    return re.search(rf"\bmark\.(?:{'|'.join(NOT_DEFAULT)})\b", ast.unparse(node)) is not None


def default_parts(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Top-level statements that default tests may execute, by the name that they define; "" if none."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and name_of(node.targets[0]) == "pytestmark" and whole_mark(node.value):
            return
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            # A mark inside parametrize is that of some rows: the others are default tests.
            if not any(whole_mark(each) for each in node.decorator_list if "parametrize" not in ast.unparse(each)):
                yield node.name, node
        else:
            yield name_of(node.targets[0]) if isinstance(node, ast.Assign) else "", node


def name_of(node: ast.expr) -> str:
    """The last part of a name, an attribute, or a literal subscript."""
    if isinstance(node, ast.Subscript):
        return str(node.slice.value) if isinstance(node.slice, ast.Constant) else name_of(node.value)
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


def is_number(node: ast.expr, below: float) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and node.value < below


def faults(node: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, what is wrong) of a piece of a test."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Call):
            called = name_of(inner.func)
            clock = isinstance(inner.func, ast.Attribute) and ast.unparse(inner.func) in ("time.time", "time.time_ns")
            if called in CLOCKS or clock:
                yield inner.lineno, f"reads {ast.unparse(inner.func)}"
            limits = [keyword.value for keyword in inner.keywords if keyword.arg == "timeout"]
            limits += inner.args[:1] if called in ("wait", "join") else []
            if any(is_number(limit, LEAST_TIMEOUT) for limit in limits):
                yield inner.lineno, f"waits less than {LEAST_TIMEOUT} s"
        elif isinstance(inner, ast.Attribute) and inner.attr in CPU_TIMES:
            yield inner.lineno, f"reads {inner.attr}"
        elif isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            for found in IN_TEXT.findall(inner.value):
                yield inner.lineno, f"reads {found} in a text"
        elif isinstance(inner, ast.Compare):
            sides = [inner.left, *inner.comparators]
            ordered = all(isinstance(op, (ast.Lt, ast.LtE, ast.Gt, ast.GtE)) for op in inner.ops)
            positive = any(isinstance(side, ast.Constant) and side.value == 0 for side in sides) and len(sides) == 2
            if ordered and not positive and any(MEASURED.fullmatch(name_of(side)) for side in sides):
                yield inner.lineno, f"compares seconds: {ast.unparse(inner)}"


def found_in(source: str) -> list[tuple[str, int, str]]:
    """(name of the part, line, what is wrong) of the default tests of a file."""
    return [(name, *fault) for name, part in default_parts(ast.parse(source)) for fault in faults(part)]


def test_no_default_test_hangs_on_a_clock():
    used, told = set(), []
    for path in files_of_tests():
        file = path.relative_to(ROOT).as_posix()
        for name, line, what in found_in(path.read_text("utf-8")):
            allowed = {file, f"{file}::{name}"} & ALLOWED.keys()
            used |= allowed
            if not allowed:
                told.append(f"{file}:{line}: {what}")
    assert told == [], "let counts stand for time, or mark the test slow"
    assert ALLOWED.keys() == used, "ALLOWED names what needs no allowance any more"


@pytest.mark.parametrize(
    "source",
    [
        "def test_a():\n    began = time.perf_counter()",
        "def test_a():\n    began = monotonic()",
        "def test_a():\n    assert time.time() - began < 3",
        "PROGRAM = 'import time; print(time.process_time())'",
        "def test_a():\n    assert tally.slowest_s < 10",
        "def test_a():\n    assert f(seconds) or facts['encode_s'] <= 2 * other['encode_s']",
        "def test_a():\n    process.communicate(timeout=30)",
        "def test_a():\n    process.wait(5.0)",
        "@pytest.mark.parametrize('x', [pytest.param(1, marks=pytest.mark.slow)])\ndef test_a(x):\n    monotonic()",
        "@pytest.fixture\ndef timed():\n    return resource.getrusage(0).ru_utime",
    ],
)
def test_what_hangs_on_a_clock_is_found(source):
    assert len(found_in(source)) == 1


@pytest.mark.parametrize(
    "source",
    [
        "@pytest.mark.slow\ndef test_a():\n    assert time.perf_counter() < 3",
        "pytestmark = [pytest.mark.cuda, pytest.mark.skipif(True, reason='')]\ndef test_a():\n    time.monotonic()",
        "def test_a(monkeypatch):\n    monkeypatch.setattr(m, 'time', SimpleNamespace(monotonic=lambda: now[0]))",
        "def test_a():\n    assert record.train_s > 0\n    process.wait(timeout=300)",
        "def test_a():\n    assert outcome.train_s == 620",
    ],
)
def test_what_cannot_fail_by_a_clock_is_let_be(source):
    assert found_in(source) == []

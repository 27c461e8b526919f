"""benchmarks/cross_device.py: a run is used by one process at a time, and what goes wrong is one short line."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "cross_device.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("cross_device", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "cross_device", module)  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    found = [tmp_path / "demo" / "3dgs" / rate for rate in ("r1", "r2", "r3")]
    for run in found:
        run.mkdir(parents=True)
        (run / "config.toml").write_text("")
    return found


def start(script: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["cross_device.py", *map(str, arguments)])
    script.main()


def test_devices_of_a_run_take_turns_and_runs_do_not(script, runs, tmp_path, monkeypatch, capsys):
    at_work: Counter[str] = Counter()
    most = {"of one run": 0, "of all": 0}
    guard, together = threading.Lock(), threading.Barrier(3, timeout=300)

    def sw(command, source, *arguments):
        if command == "decode":
            return {"digest": source.read_text(), "decode_s": 0.0}
        with guard:
            at_work[source.name] += 1
            most["of one run"] = max(most["of one run"], *at_work.values())
            most["of all"] = max(most["of all"], sum(at_work.values()))
        if "cpu" in arguments:  # the first of each run
            together.wait()
        with guard:
            at_work[source.name] -= 1
        arguments[arguments.index("--out") + 1].write_text(source.name)
        return {"encode_s": 0.0}

    monkeypatch.setattr(script, "sw", sw)
    start(script, monkeypatch, tmp_path, "--jobs", 3)
    assert most == {"of one run": 1, "of all": 3}
    assert capsys.readouterr().out.count("identical") == 6


def test_decodings_that_differ_end_with_status_1(script, runs, tmp_path, monkeypatch, capsys):
    def sw(command, source, *arguments):
        if command == "encode":
            arguments[arguments.index("--out") + 1].write_text("")
        device = arguments[arguments.index("--device") + 1]
        return {"digest": device, "decode_s": 0.0, "encode_s": 0.0}

    monkeypatch.setattr(script, "sw", sw)
    with pytest.raises(SystemExit, match="6 of 6 files failed, or decode differently"):
        start(script, monkeypatch, tmp_path)
    assert capsys.readouterr().out.count("DIFFER") == 6


def test_an_error_is_one_short_line(script, runs, tmp_path, monkeypatch, capsys):
    said = "computing on cpu\nerror: no finished training " + "of this configuration " * 20

    def run(command, **_):
        return subprocess.CompletedProcess(command, 2, "", said)

    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(SystemExit, match="3 of 3 files failed"):
        start(script, monkeypatch, tmp_path, "--devices", "cpu")
    rows = [line for line in capsys.readouterr().out.splitlines() if "3dgs" in line]
    assert len(rows) == 3
    assert all("encode: no finished training of this" in row and " ..." in row for row in rows)
    assert len(script.short(said)) == 100

"""Output of a step that runs in a process of its own."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from forked_children import starting

from splatwizard_core.errors import SplatwizardError
from splatwizard_core.runs import fresh


@pytest.mark.parametrize("printed", ["[]", '[["a", 1]]', "null", "3", '"text"', "", "{"])
def test_what_is_no_object_is_refused(monkeypatch: pytest.MonkeyPatch, printed: str):
    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 0, stdout=printed, stderr="")

    monkeypatch.setattr(fresh.subprocess, "run", run)
    with pytest.raises(fresh.FreshProcessError, match="`sw decode` in a fresh process did not print a JSON object"):
        fresh.run_fresh(["decode"])


def test_one_that_was_started_ahead_does_what_it_is_told(tmp_path: Path):
    (tmp_path / "broken.swz").write_bytes(b"no such file")
    failed = pytest.raises(SplatwizardError, match=r"`sw decode` in a fresh process failed \(status \d\): broken.swz")
    with starting(), fresh.started_ahead() as ahead, failed:
        fresh.run_fresh(["decode", str(tmp_path / "broken.swz")], ahead=ahead)


def test_one_that_was_started_ahead_in_vain_ends_quietly(capfd: pytest.CaptureFixture[str]):
    with starting(), fresh.started_ahead():
        pass  # its end is waited for
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(sys.platform == "win32", reason="signals are not sent there")
def test_one_that_was_started_ahead_is_interrupted_without_a_traceback():
    command = [sys.executable, "-X", "importtime", *fresh.CHILD[1:], "--ahead"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        assert child.stderr is not None
        for line in child.stderr:  # it says so once it has imported torch, and waits
            if line.endswith("| torch\n"):
                break
        child.send_signal(signal.SIGINT)
        assert "Traceback" not in child.stderr.read()
    assert child.returncode == -signal.SIGINT


@pytest.mark.skipif(not hasattr(os, "waitid"), reason="the system does not tell that it has ended")
def test_one_that_was_started_ahead_and_died_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fresh, "CHILD", (sys.executable, "-c", "raise SystemExit(3)"))
    failed = pytest.raises(fresh.FreshProcessError, match=r"failed \(status 3\): see above")
    with starting(), fresh.started_ahead() as ahead, failed:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)
        fresh.run_fresh(["eval"], ahead=ahead)

"""Output of a step that runs in a process of its own."""

import subprocess

import pytest

from splatwizard_core.runs import fresh


@pytest.mark.parametrize("printed", ["[]", '[["a", 1]]', "null", "3", '"text"', "", "{"])
def test_what_is_no_object_is_refused(monkeypatch: pytest.MonkeyPatch, printed: str):
    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 0, stdout=printed, stderr="")

    monkeypatch.setattr(fresh.subprocess, "run", run)
    with pytest.raises(fresh.FreshProcessError, match="`sw decode` in a fresh process did not print a JSON object"):
        fresh.run_fresh(["decode"])

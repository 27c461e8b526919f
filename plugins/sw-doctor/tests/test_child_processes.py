"""Checks in a child process: noise, exceptions, a process that dies or hangs."""

from __future__ import annotations

from pathlib import Path

import pytest
from sw_doctor import child, diagnosis

from splatwizard_core.plugins.check import Check


def serving(site: Path, *steps: str) -> str:
    body = "\n".join(steps)
    (site / "served.py").write_text(
        "import os, sys, time\n"
        "from splatwizard_core.plugins.check import Check\n"
        "from sw_doctor.child import serve\n"
        "def ok(name):\n    print('noise')\n    return [Check('g', name, 'ok', 'fine')]\n"
        f"def bad():\n    {body}\n"
        "serve([('one', lambda: ok('one')), ('two', bad), ('three', lambda: ok('three'))])\n"
    )
    return "served"


def test_noise_and_exceptions_do_not_stop_the_steps(site):
    answer = child.ask(serving(site, "raise RuntimeError('two\\nlines')"), timeout=300)
    assert answer.died_in is None
    assert [(c.name, c.state) for c in answer.checks] == [("one", "ok"), ("two", "broken"), ("three", "ok")]
    assert answer.checks[1].detail == "RuntimeError: two lines"


@pytest.mark.parametrize(
    ("step", "how"),
    [
        ("os.kill(os.getpid(), 11)", "was killed by signal SIGSEGV"),
        ("print('last words', file=sys.stderr); os._exit(3)", "ended with status 3: last words"),
        ("open('hangs', 'w').close(); time.sleep(3600)", "gave no answer within 0.1 s"),
        ("os._exit(0)", "ended before it had answered"),
    ],
)
def test_a_process_that_dies_or_hangs_is_a_finding(site, tmp_path, monkeypatch, out_of_patience, step, how):
    monkeypatch.chdir(tmp_path)
    out_of_patience(tmp_path / "hangs")
    answer = child.ask(serving(site, step), timeout=0.1)
    assert answer.died_in is not None
    assert answer.died_in[0] == "two"
    assert how in answer.died_in[1]
    broken = diagnosis.probed(answer)[-1]
    assert (broken.state, broken.needed) == ("broken", True)


def test_a_process_that_a_stranger_ends_after_the_main_job_decides_nothing():
    job = Check("main job", "sw run", "ok", "fine", needed=True)
    answer = child.Answer([job], ("entries of sw-thing", "was killed by signal SIGSEGV"))
    _, found = diagnosis.probed(answer)
    assert (found.group, found.state, found.needed) == ("plugins", "broken", False)
    assert "pip uninstall sw-thing" in (found.mend or "")

"""Checks that other packages register: run apart, one line each, never decisive."""

from __future__ import annotations

import os

import pytest
from doctored import distribution
from sw_doctor import registered

from splatwizard_core.plugins import Entry


@pytest.fixture
def check_of(site):
    """(body of the check, **fields) -> entry of a check that the installed distribution sw-stranger registers."""

    def register(body: str, **fields: object) -> Entry:
        distribution(
            site, "sw-stranger",
            sw_stranger="from splatwizard_core.api import hookimpl\n"
            "@hookimpl\n"
            "def register_checks(registry):\n"
            f"    registry.add('strange', 'sw_strange:check', summary='', **{fields!r})\n",
            sw_strange="import os, sys, time\n"
            "from splatwizard_core.tooling import Check\n"
            f"def check():\n    {body}\n",
        )  # fmt: skip
        info = site / "sw_stranger-1.0.dist-info"
        (info / "entry_points.txt").write_text("[splatwizard]\nstranger = sw_stranger\n")
        return Entry("check", "strange", "sw_strange:check", "", fields, "sw-stranger", "1.0")

    return register


def test_a_registered_check_runs_in_a_process_of_its_own(check_of):
    entry = check_of("return [Check('radio', 'aerial', 'missing', str(os.getpid()), 'buy one', facts={'n': 1})]")
    (found,) = registered.run_registered(entry)
    assert (found.group, found.name, found.state, found.mend, found.facts) == (
        "radio", "aerial", "missing", "buy one", {"n": 1}
    )  # fmt: skip
    assert found.detail != str(os.getpid())


@pytest.mark.parametrize(
    ("body", "how"),
    [
        ("os.abort()", "was killed by signal SIGABRT"),
        ("open('hangs', 'w').close(); time.sleep(3600)", "gave no answer within 0.1 s"),
        ("os._exit(0)", "ended before it had answered"),
        ("os._exit(4)", "ended with status 4"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("raise OSError('no\\nradio')", "OSError: no radio"),
        ("return 'fine'", "no list of Check"),
        ("return [Check('g', 'n', 'fine', '')]", "the state of 'n' is 'fine'"),
        ("return [Check('g', 'n', 'ok', '', facts={'n': float('nan')})]", "Out of range float"),
        ("import no_such_library", "No module named 'no_such_library'"),
    ],
)
def test_a_registered_check_that_fails_is_one_line_with_its_distribution(
    check_of, tmp_path, monkeypatch, out_of_patience, body, how
):
    monkeypatch.chdir(tmp_path)
    out_of_patience(tmp_path / "hangs")
    entry = check_of(body, group="radio")
    (found,) = registered.run_registered(entry, seconds=0.1)
    assert (found.group, found.name, found.state, found.needed) == ("radio", "strange", "broken", False)
    assert how in found.detail
    assert "sw-stranger" in found.detail
    assert "\n" not in found.detail
    assert ("pip install no_such_library" if "no_such" in body else "sw-stranger") in (found.mend or "")


def test_what_a_registered_check_prints_stands_nowhere(check_of, capfd):
    entry = check_of("print('noise'); os.write(1, b'more'); return [Check('g', 'n', 'ok', 'fine')]")
    (found,) = registered.run_registered(entry)
    assert (found.state, found.detail) == ("ok", "fine")
    assert capfd.readouterr() == ("", "")


def test_a_registered_check_decides_nothing_about_the_main_job(check_of):
    entry = check_of("return [Check('main job', 'sw run', 'broken', 'a\\nb' + 'x' * 999, 'c\\nd', True)]")
    (found,) = registered.run_registered(entry)
    assert (found.group, found.needed, found.mend) == ("checks", False, "c d")
    assert "\n" not in found.detail
    assert len(found.detail) < 400


def test_a_registered_check_is_left_out_where_what_it_needs_does_not_work():
    def needs_of(**fields: object) -> set[str]:
        return registered.needs_of(Entry("check", "c", "module:attribute", "", fields))

    assert needs_of(needs="torch") == {"torch"}
    assert needs_of(needs=["torch", "C++"]) == {"torch", "C++"}
    assert needs_of() == needs_of(needs=3) == set()

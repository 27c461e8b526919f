"""Checks that installed packages register: each runs in a process of its own and can spoil no other finding."""

from __future__ import annotations

from splatwizard_core.tooling import Check, Entry
from sw_doctor import child
from sw_doctor.remedies import remedy_of
from sw_doctor.text import one_line

RUNNER = "sw_doctor.child_check"
SECONDS = 180.0  # torch takes long from a slow network disk and on a busy machine; a hang has to end all the same
GROUP = "checks"  # of entries that declare none
MAIN_JOB = "main job"  # a group of the diagnosis alone
LONGEST_NAME = 60


def run_registered(entry: Entry, *, seconds: float = SECONDS) -> list[Check]:
    """Findings of a registered check; one broken check that names its distribution if its process dies or hangs.

    None of them is `needed`: what a package registers does not decide whether `sw run` works.
    """
    try:
        answer = child.ask(RUNNER, [entry.name], timeout=seconds)
        if answer.died_in is not None:
            return [failed(entry, f"did not end well: its process {answer.died_in[1]}")]
        return [_tamed(check, entry) for check in answer.checks]
    except (TypeError, ValueError) as error:  # a finding with other fields than Check has
        return [failed(entry, one_line(f"returned something else than findings: {error}"))]


def needs_of(entry: Entry) -> set[str]:
    """Names of the checks without which this one can only fail, as its entry declares: `needs="torch"`."""
    needs = entry.declared.get("needs", ())
    if isinstance(needs, str):
        return {needs}
    return set(map(str, needs)) if isinstance(needs, (list, tuple)) else set()


def failed(entry: Entry, how: str) -> Check:
    """Finding about a check that failed itself."""
    mend = remedy_of(entry.distribution, how, foreign=entry.foreign)
    return Check(_group(entry), entry.name, "broken", f"the check of {entry.distribution} {how}", mend)


def _group(entry: Entry) -> str:
    group = one_line(entry.declared.get("group", GROUP), LONGEST_NAME)
    return GROUP if group == MAIN_JOB else group


def _tamed(check: Check, entry: Entry) -> Check:
    """A finding with texts of one line, in a group that packages may have, without effect on the verdict."""
    group = one_line(check.group, LONGEST_NAME)
    return Check(
        _group(entry) if group == MAIN_JOB else group,
        one_line(check.name, LONGEST_NAME),
        check.state,
        one_line(check.detail),
        None if check.mend is None else one_line(check.mend),
        facts=check.facts,
    )

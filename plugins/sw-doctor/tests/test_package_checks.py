"""Findings of `sw doctor` about required and optional packages, and the line that mends each."""

from __future__ import annotations

import pytest
from doctored import distribution
from sw_doctor import diagnosis, packages
from sw_doctor.remedies import remedy_of


def test_requirements_and_extras_come_from_the_metadata(site):
    distribution(
        site, "sw-thing",
        requires=("lib-a>=1", "splatwizard-core>=0.1", "sw-other", "old; python_version < '3'",
                  "lib-b; extra == 'fast'", "lib-c>=2; extra == 'fast'", "not//valid"),
        extras=("fast",),
    )  # fmt: skip
    distribution(site, "splatwizard-core")
    needs = packages.collect_needs(["sw-thing", "not-installed"])
    assert list(needs.required) == ["lib-a"]
    assert {name: [r.name for r in found] for name, found in needs.extras.items()} == {
        "sw-thing[fast]": ["lib-b", "lib-c"]
    }
    assert needs.names() == ["lib-a", "lib-b", "lib-c"]


def test_what_lies_below_the_core_is_asked_too(site):
    distribution(site, "splatwizard-below", requires=("lib-z>=3",))
    distribution(site, "sw-thing", requires=("lib-a", "splatwizard-below>=0.1", "splatwizard-absent"))
    assert list(packages.collect_needs(["sw-thing"]).required) == ["lib-a", "lib-z"]


def test_packages_are_imported_and_one_that_crashes_takes_no_other_along(site):
    distribution(site, "good", good="print('noise on stdout')")
    distribution(site, "crash", crash="import os\nos.abort()\n")
    distribution(site, "wrong", wrong="import no_such_library\n")
    distribution(site, "leave", leave="raise SystemExit(3)\n")
    distribution(site, "after", after="")
    found = packages.try_imports(["good", "crash", "wrong", "leave", "absent", "after"])
    assert found["good"] is None
    assert found["after"] is None
    assert found["crash"] == "the process that imports it was killed by signal SIGABRT"
    assert "No module named 'no_such_library'" in (found["wrong"] or "")
    assert "SystemExit" in (found["leave"] or "")
    assert "absent" not in found


def test_each_package_that_does_not_work_has_its_line(site):
    distribution(
        site, "sw-thing",
        requires=("there>=1", "absent>=3", "old>=2", "bad", "lib-x; extra == 'gone'", "there; extra == 'here'",
                  "bad; extra == 'sick'"),
        extras=("gone", "here", "sick"),
    )  # fmt: skip
    for name in ("there", "old", "bad"):
        distribution(site, name)
    problems = {"there": None, "old": None, "bad": "does not import: OSError: libfoo.so"}
    checks = {c.name: c for c in packages.package_checks(packages.collect_needs(["sw-thing"]), problems)}
    assert (checks["absent"].state, checks["absent"].mend) == ("missing", "pip install 'absent>=3'")
    assert checks["absent"].needed
    assert checks["old"].state == "broken"
    assert "is 1.0; needed is >=2" in checks["old"].detail
    assert "libfoo.so" in checks["bad"].detail
    assert checks["required"].detail == "1 of 4 packages work"
    assert (checks["sw-thing[gone]"].state, checks["sw-thing[gone]"].mend) == (
        "missing", "pip install 'sw-thing[gone]'"
    )  # fmt: skip
    assert not checks["sw-thing[gone]"].needed
    assert checks["sw-thing[here]"].state == "ok"
    assert checks["sw-thing[sick]"].state == "broken"


@pytest.mark.parametrize(
    ("why", "mend"),
    [
        ("No module named 'jax'", "pip install jax"),
        ("No module named 'heavy_lib'", "pip install --upgrade --force-reinstall --no-deps heavy-lib"),
        ("No module named 'weighty'", "pip install --upgrade --force-reinstall --no-deps heavy-lib"),
        ("No module named 'heavy_lib.csrc'", "pip install --upgrade --force-reinstall --no-deps heavy-lib"),
        ("OSError: libheavy.so", "pip install --upgrade --force-reinstall --no-deps heavy-lib"),
    ],
)
def test_an_extra_gets_what_it_lacks_or_is_put_there_anew(site, why, mend):
    distribution(site, "heavy-lib", weighty="")
    distribution(site, "sw-thing", requires=("heavy-lib; extra == 'fast'",), extras=("fast",))
    needs = packages.collect_needs(["sw-thing"])
    checks = {c.name: c for c in packages.package_checks(needs, {"heavy-lib": f"does not import: {why}"})}
    assert (checks["sw-thing[fast]"].state, checks["sw-thing[fast]"].mend) == ("broken", mend)


def test_what_only_a_stranger_needs_decides_nothing_about_the_main_job(site):
    for name in ("old", "bad", "shared"):
        distribution(site, name)
    distribution(site, "sw-thing", requires=("shared>=1",))
    distribution(site, "stranger", requires=("absent", "old>=2", "bad", "shared<1"))
    needs = packages.collect_needs(["sw-thing"], ["stranger"])
    checks = {c.name: c for c in packages.package_checks(needs, {"bad": "does not import: OSError", "shared": None})}
    assert set(checks) == {"bad", "required"}  # what it has not is told in its plugin's line
    assert (checks["bad"].state, checks["bad"].needed) == ("broken", False)


@pytest.mark.parametrize(
    ("why", "foreign", "mend"),
    [
        ("needs numpy>=9, but 2.0 is installed: pip install 'numpy>=9'", True, "pip install 'numpy>=9'"),
        ("ModuleNotFoundError: No module named 'jax'", True, "pip install jax"),
        ("ModuleNotFoundError: No module named 'jax'", False, "pip install jax"),
        ("ModuleNotFoundError: No module named 'sw_thing'", False, "pip install --force-reinstall --no-deps sw-thing"),
        ("its entry point is called 'core', which is the name of ...", True, "pip uninstall sw-thing"),
        ("OSError: no disk", True,
         "pip install --upgrade sw-thing  (or, to be without it: pip uninstall sw-thing)"),
        ("OSError: no disk", False, "pip install --force-reinstall --no-deps sw-thing"),
    ],
)  # fmt: skip
def test_the_cure_of_a_plugin_is_what_helps_against_its_reason(site, why, foreign, mend):
    distribution(site, "sw-thing", sw_thing="")
    assert remedy_of("sw-thing", why, foreign=foreign) == mend


def test_a_distribution_in_two_places_is_told_with_both(site, tmp_path, monkeypatch):
    distribution(site, "sw-thing")
    assert diagnosis.check_shadowed("sw-thing") is None
    distribution(tmp_path / "other", "sw-thing")
    monkeypatch.syspath_prepend(str(tmp_path / "other"))
    found = diagnosis.check_shadowed("sw-thing")
    assert found is not None
    assert f"1.0 in {tmp_path / 'other'} is used, 1.0 in {site} is shadowed" in found.detail
    assert not found.needed

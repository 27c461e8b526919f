"""`sw build-kernels`: what it reports, and its exit status."""

from __future__ import annotations

import json

from sw_doctor import declared_modules as kernels

from splatwizard_core.cli.main import main
from splatwizard_core.errors import SplatwizardError
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_native import ForeseenError, NativeBuildError


def test_what_cannot_be_built_is_an_error_for_the_user(capsys, monkeypatch):
    assert issubclass(NativeBuildError, ForeseenError)
    assert not issubclass(NativeBuildError, SplatwizardError)  # the base does not know the core
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert main(["build-kernels"]) == 1
    assert capsys.readouterr().err == "error: $CXX is 'no-such-compiler', which is not there: unset CXX or correct it\n"


def test_build_kernels_reports_each_module_and_ends_with_status_1_if_one_fails(capsys, monkeypatch):
    monkeypatch.setattr(kernels, "CORE_MODULES", ("no_such_module:X",))
    monkeypatch.setattr("sw_doctor.build_kernels.load_plugins", lambda: PluginManager([]))
    monkeypatch.setenv("CXX", "true")  # there, and not called
    assert main(["build-kernels", "--json"]) == 1
    (row,) = json.loads(capsys.readouterr().out)["modules"]
    assert (row["name"], row["state"], row["path"]) == ("no_such_module:X", "failed", None)
    assert "no_such_module" in row["error"]

"""`sw doctor` as a user runs it, on machines that are made to lack things."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import forked_children
import pytest
from advice import as_written
from forked_children import run_python

from splatwizard_native import NativeBuildError, find_compiler


def doctor(*arguments: str, **env: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("SW_PLUGINS", "SPLATWIZARD_DATA", "SPLATWIZARD_NATIVE")}
    if "PYTHONPATH" in env:
        env["PYTHONPATH"] = os.pathsep.join(filter(None, (env["PYTHONPATH"], os.environ.get("PYTHONPATH"))))
    return run_python("-m", "splatwizard_core", "doctor", *arguments, env={**kept, **env})


def checks_of(done: subprocess.CompletedProcess[str]) -> dict[str, dict[str, Any]]:
    return {c["name"]: c for c in json.loads(done.stdout)["checks"]}


def plugin(site: Path, name: str, source: str, *more: str) -> None:
    """An installed distribution with a `splatwizard` entry point; `more` are lines of its metadata."""
    module = name.replace("-", "_")
    info = site / f"{module}-0.1.dist-info"
    info.mkdir(parents=True)
    (site / f"{module}.py").write_text(source)
    (info / "METADATA").write_text("\n".join(["Metadata-Version: 2.1", f"Name: {name}", "Version: 0.1", *more]) + "\n")
    (info / "entry_points.txt").write_text(f"[splatwizard]\n{name.removeprefix('sw-')} = {module}\n")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """What `sw doctor` says of this machine, and what it asked of the C++ compiler, a line each."""
    folder = tmp_path_factory.mktemp("compiler")
    asked, noting = folder / "asked", folder / "c++"
    asked.touch()
    try:
        noting.write_text(f'#!/bin/sh\necho "$@" >> {asked}\nexec {shlex.join(find_compiler())} "$@"\n')
    except NativeBuildError:
        return doctor("--json"), []
    noting.chmod(0o755)
    return doctor("--json", CXX=str(noting)), asked.read_text().splitlines()


def test_this_machine_can_do_the_main_job(sound):
    done, _ = sound
    assert done.returncode == 0, done.stdout
    found = json.loads(done.stdout)
    assert found["ok"] is True
    for check in found["checks"]:
        assert check["state"] in ("ok", "missing", "broken")
        assert "\n" not in check["detail"]
        assert "\n" not in (check["mend"] or "")
    checks = checks_of(done)
    assert {
        "Python",
        "torch",
        "CUDA",
        "C++",
        "nvcc",
        "sw_rasterizers",
        "reference",
        "memory",
        "sw-3dgs",
        "LPIPS package",
    } <= set(checks)
    assert checks["sw run --method 3dgs --scene demo"]["state"] == "ok"
    assert done.stderr == ""


def test_it_is_done_while_one_waits(sound):
    """It compiles a few lines; kernels would take minutes."""
    compiled = [line for line in sound[1] if line.endswith((".cpp", ".so", ".o", "out"))]
    assert len(compiled) <= 1
    assert all("sw-doctor-" in line for line in compiled)


RADIO = """
import os
from splatwizard_core.api import hookimpl
from splatwizard_core.tooling import Check

@hookimpl
def register_checks(registry):
    registry.add("aerial", "sw_radio:aerial", summary="", group="radio")
    registry.add("fuse", "sw_radio:fuse", summary="", group="radio")
    registry.add("liar", "sw_radio:liar", summary="")

def aerial():
    return [Check("radio", "aerial", "missing", "none is plugged in", "buy one")]

def fuse():
    os.abort()

def liar():
    return [Check("main job", "liar", "broken", "nothing works", needed=True)]
"""
"""A stranger's checks: one that works, one that kills its process, one that claims to be the main job."""


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """Findings about a machine that has no compiler, a cache that cannot be written, and strangers' plugins."""
    root = tmp_path_factory.mktemp("faulty")
    site, binaries = root / "site", root / "bin"
    plugin(site, "sw-bad", "import no_such_library\n")
    plugin(site, "sw-needy", "", "Requires-Dist: sw-absent")
    plugin(site, "sw-extra", "", "Provides-Extra: speed", "Requires-Dist: no-such-package>=2; extra == 'speed'")
    plugin(site, "sw-radio", RADIO)
    binaries.mkdir()
    (root / "file").write_text("")
    env = {"PYTHONPATH": str(site), "PATH": str(binaries), "SPLATWIZARD_CACHE": str(root / "file" / "cache")}
    return doctor("--json", **{**env, "CXX": "", "SPLATWIZARD_DATA": str(root / "nowhere")})


def test_everything_that_is_wrong_has_its_own_line(faulty):
    checks = checks_of(faulty)
    states = {name: checks[name]["state"] for name in ("C++", "cache folder", "sw-bad", "sw-needy", "SPLATWIZARD_DATA")}
    assert states == {
        "C++": "missing", "cache folder": "broken", "sw-bad": "broken", "sw-needy": "broken",
        "SPLATWIZARD_DATA": "broken",
    }  # fmt: skip
    assert "no_such_library" in checks["sw-bad"]["detail"]
    assert as_written(checks["sw-needy"]["mend"]) == "pip install sw-absent"
    assert checks["sw-extra"]["state"] == "ok"
    extra = {**checks["sw-extra[speed]"], "mend": as_written(checks["sw-extra[speed]"]["mend"])}
    assert extra == {
        "group": "packages", "name": "sw-extra[speed]", "state": "missing", "detail": "not installed: no-such-package",
        "mend": "pip install 'sw-extra[speed]'", "needed": False, "facts": {},
    }  # fmt: skip
    # Kernels cannot be built here, so it is slow, but it works: the reference draws.
    assert checks["sw_rasterizers"]["state"] in ("missing", "ok")  # ok: prebuilt beside its sources
    assert faulty.returncode == 0


def test_checks_of_strangers_stand_beside_ours_and_harm_none(faulty):
    checks = checks_of(faulty)
    assert (checks["aerial"]["state"], checks["aerial"]["mend"]) == ("missing", "buy one")
    assert (checks["fuse"]["group"], checks["fuse"]["state"]) == ("radio", "broken")
    assert "the check of sw-radio" in checks["fuse"]["detail"]
    assert "SIGABRT" in checks["fuse"]["detail"]
    assert (checks["liar"]["group"], checks["liar"]["needed"]) == ("checks", False)


def test_without_a_torch_that_imports_the_main_job_cannot_run_and_what_needs_torch_is_not_checked(tmp_path):
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch" / "__init__.py").write_text("raise ImportError('libtorch.so: cannot open shared object file')")
    with forked_children.starting():  # forked processes have torch
        done = doctor(PYTHONPATH=str(tmp_path))
    assert done.returncode == 1
    assert "cannot run here" in done.stdout
    assert "libtorch.so" in done.stdout
    assert re.search(r"-> pip install --force-reinstall torch -c \S*constraints.txt", as_written(done.stdout))
    assert "LPIPS" not in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


def test_without_the_method_the_main_job_cannot_run():
    done = doctor("--json", SW_PLUGINS="doctor,datasets,rasterizers")
    assert done.returncode == 1
    job = checks_of(done)["sw run"]
    assert (job["state"], job["detail"], job["mend"]) == ("broken", "not installed: a method", "unset SW_PLUGINS")


def test_a_gpu_without_the_package_gsplat_is_told_how_to_get_it(monkeypatch):
    import importlib.util

    import torch
    from sw_doctor import probe

    from splatwizard_core.plugins import load_plugins

    find_spec = importlib.util.find_spec
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "gsplat" else find_spec(name, *a))
    plugins = load_plugins()
    found = probe._check_rasterizer(plugins.rasterizers.entry("gsplat"), plugins)
    assert (found.state, found.detail) == ("missing", "gsplat is not installed")
    assert found.mend == "pip install 'sw-gsplat[gsplat]'"


def test_beside_the_core_alone_it_names_the_packages_that_a_run_needs(core, wheels):
    core.install(wheels["sw-doctor"])
    done = core.run("doctor", "--json", check=False)
    assert done.returncode == 1
    checks = checks_of(done)
    job = checks["sw run"]
    assert (job["state"], job["needed"]) == ("broken", True)
    assert as_written(job["mend"]) == "pip install sw-3dgs sw-datasets sw-rasterizers"
    assert {name: check for name, check in checks.items() if check["needed"] and check["state"] != "ok"} == {
        "sw run": job
    }

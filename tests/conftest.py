"""Fixtures that build our wheels and fresh environments."""

from __future__ import annotations

import fcntl
import importlib.metadata
import json
import os
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from fresh_environments import WORKSPACE, FreshEnvironment, build_wheels, is_ours, make_environment
from import_graph import needed

collect_ignore = ["golden/packages_0_2"]  # its tests run where it is installed (test_package_of_0_2.py)


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that the first worker of the session fills by `make`, while the others wait for it."""
    base = factory.getbasetemp()
    folder = (base.parent if "TEST_WORKER" in os.environ else base) / name
    with open(f"{folder}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (made := folder.with_suffix(".made")).exists():
            folder.mkdir()
            make(folder)
            made.touch()
    return folder


@pytest.fixture(scope="session")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One wheel of each workspace package, by distribution name."""
    folder = made_once(tmp_path_factory, "wheels", lambda folder: build_wheels(WORKSPACE, folder))
    return {path.name.partition("-")[0].replace("_", "-"): path for path in folder.glob("*.whl")}


@pytest.fixture(scope="session")
def core_environment(tmp_path_factory: pytest.TempPathFactory, wheels: dict[str, Path]) -> FreshEnvironment:
    """An environment with third-party packages, the core and what it requires of ours; to be cloned, not changed."""

    def make(folder: Path) -> None:
        make_environment(folder / "env").pip_install(*(wheels[name] for name in needed("splatwizard-core")))

    return FreshEnvironment(made_once(tmp_path_factory, "core", make) / "env")


@pytest.fixture
def core(core_environment: FreshEnvironment, tmp_path: Path) -> FreshEnvironment:
    """An environment of the test's own with nothing of ours but the core."""
    return core_environment.clone(tmp_path / "env")


@pytest.fixture
def make_plugin(tmp_path: Path):
    """make_plugin(name, plugin_source, requires=(), version="0.1") -> wheel of a one-module plugin distribution."""

    def make(name: str, source: str, requires: tuple[str, ...] = (), version: str = "0.1") -> Path:
        module = name.replace("-", "_")
        project = tmp_path / "projects" / name
        project.mkdir(parents=True)
        (project / f"{module}.py").write_text(textwrap.dedent(source))
        (project / "pyproject.toml").write_text(
            textwrap.dedent(f"""
            [build-system]
            requires = ["hatchling"]
            build-backend = "hatchling.build"
            [project]
            name = "{name}"
            version = "{version}"
            dependencies = {json.dumps(list(requires))}
            [project.entry-points.splatwizard]
            {name.removeprefix("sw-")} = "{module}"
            [tool.hatch.build.targets.wheel]
            only-include = ["{module}.py"]
            """)
        )
        out = tmp_path / "plugin-wheels"
        out.mkdir(exist_ok=True)
        return build_wheels([project], out)[0]

    return make


def pytest_report_header() -> str:
    ours = [d for d in importlib.metadata.distributions() if is_ours(d.metadata["Name"])]
    return "splatwizard: " + ", ".join(sorted(f"{d.metadata['Name']} {d.version}" for d in ours))

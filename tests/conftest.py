"""Fixtures that build our wheels and fresh environments."""

from __future__ import annotations

import importlib.metadata
import json
import textwrap
from pathlib import Path

import pytest
from fresh_environments import WORKSPACE, FreshEnvironment, build_wheels, is_ours, make_environment
from import_graph import needed

collect_ignore = ["golden/packages_0_2"]  # its tests run where it is installed (test_package_of_0_2.py)


@pytest.fixture(scope="session")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One wheel of each workspace package, by distribution name."""
    out = tmp_path_factory.mktemp("wheels")
    return dict(zip((project.name for project in WORKSPACE), build_wheels(WORKSPACE, out), strict=True))


@pytest.fixture(scope="session")
def core_environment(tmp_path_factory: pytest.TempPathFactory, wheels: dict[str, Path]) -> FreshEnvironment:
    """An environment with third-party packages, the core and what it requires of ours; to be cloned, not changed."""
    environment = make_environment(tmp_path_factory.mktemp("core") / "env")
    environment.install(*(wheels[name] for name in needed("splatwizard-core")))
    return environment


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

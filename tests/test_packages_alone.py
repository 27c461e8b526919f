"""Each package as a wheel of its own: beside the core and what it declares alone, and named when it is gone."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from advice import as_written
from fresh_environments import FreshEnvironment
from import_graph import PACKAGES, needed, project

from splatwizard_core.coding.container import ContainerReader

GOLDEN = Path(__file__).parent / "golden"
ONE_OF_EACH_METHOD = sorted({ContainerReader.open(p).method: p for p in sorted(GOLDEN.glob("*.swz"))}.values())
ALONE_IN_DEFAULT_TESTS = {"sw-hac-plus"}
"""The rest is slow: that a package declares what it imports is also read off its source (test_layers)."""
IN_EVERY_ENVIRONMENT = needed("splatwizard-core")
BY_NAME = {str(project(package)["name"]): package for package in PACKAGES}
IMPORT_ALL = """
import importlib, pkgutil, sys
from splatwizard_core.tooling import load_plugins
plugins = load_plugins()
assert not plugins.broken, plugins.broken
(own,) = [p for p in plugins.plugins if p.distribution == sys.argv[2]] or [None]
assert (own is not None and bool(plugins.provided_by(own))) == (sys.argv[3] == "True"), own
package = importlib.import_module(sys.argv[1])
for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
"""


@pytest.mark.pipeline
@pytest.mark.parametrize(
    "distribution",
    [pytest.param(name, marks=[] if name in ALONE_IN_DEFAULT_TESTS else pytest.mark.slow) for name in sorted(BY_NAME)],
)
def test_a_package_works_alone_beside_the_core(core, wheels, distribution):
    core.install(*(wheels[name] for name in needed(distribution) if name not in IN_EVERY_ENVIRONMENT))
    provides = "entry-points" in project(BY_NAME[distribution])
    core.python_c(IMPORT_ALL, BY_NAME[distribution].name, distribution, str(provides))


@pytest.fixture(scope="module")
def everything(tmp_path_factory, core_environment, wheels) -> FreshEnvironment:
    environment = core_environment.clone(tmp_path_factory.mktemp("everything") / "env")
    environment.install(*(wheel for name, wheel in wheels.items() if name not in IN_EVERY_ENVIRONMENT))
    return environment


@pytest.fixture(scope="module")
def providers(everything) -> dict[str, str]:
    """Method -> the distribution that provides it."""
    return {
        each["name"]: distribution
        for distribution, row in everything.plugins().items()
        for each in row["provides"]
        if each["kind"] == "method"
    }


@contextlib.contextmanager
def uninstalled(environment: FreshEnvironment, distributions: Iterable[str]) -> Iterator[None]:
    """The environment without some distributions, for a while."""
    (site,) = environment.prefix.glob("lib/python*/site-packages")
    stems = {distribution.replace("-", "_") for distribution in distributions}
    taken = [path for stem in stems for path in (site / stem, *site.glob(f"{stem}-*.dist-info"))]
    assert len(taken) == 2 * len(stems)
    away = environment.prefix / "away"
    away.mkdir()
    for path in taken:
        path.rename(away / path.name)
    yield
    for path in taken:
        (away / path.name).rename(path)
    away.rmdir()


@pytest.mark.pipeline
def test_a_file_whose_provider_is_gone_names_it(everything, providers):
    """The header knows its packages; of older files that do not, the catalogue does."""
    named = [providers[ContainerReader.open(path).method] for path in ONE_OF_EACH_METHOD]
    with uninstalled(everything, named):
        told = everything.run_each([["decode", str(path)] for path in ONE_OF_EACH_METHOD])
    for provider, done in zip(named, told, strict=True):
        assert done.status == 2
        assert re.search(rf"pip install '?{provider}\b", as_written(done.stderr)), provider
        assert "Traceback" not in done.stderr


@pytest.mark.pipeline
def test_a_library_that_is_gone_is_named(everything):
    with uninstalled(everything, ["sw-codecs"]):
        done = everything.run("decode", str(GOLDEN / "3dgs_r3_v1.swz"), check=False)
    assert done.returncode == 2
    assert "needs sw-codecs, which is not installed: pip install sw-codecs" in as_written(done.stderr)


NAMED = {
    "report out": "sw-report", "doctor": "sw-doctor", "data list": "sw-datasets", "render x.swz": "sw-view",
    "bench": "sw-bench", "run --scene a,b": "sw-bench", "run --method hac": "sw-hac",
    "info mipnerf360/garden": "sw-report", "export x.swz x.ply": "sw-interchange", "truncate x.swz": "sw-lod",
}  # fmt: skip


@pytest.mark.pipeline
def test_the_core_alone_names_the_package_of_what_is_asked_for(core_environment):
    for (command, package), done in zip(NAMED.items(), core_environment.run_each(map(str.split, NAMED)), strict=True):
        assert done.status == 2, command
        assert f"pip install {package}" in as_written(done.stderr), command

"""How all tests of the workspace run: hypothesis without deadlines, no more threads than cores, long files first."""

import contextlib
import gc
import sys
from collections.abc import Iterator
from pathlib import Path

import cores  # before torch
import forked_children
import pytest
import torch
from forked_children import SELDOM
from forked_workers import run_forked
from hypothesis import HealthCheck, settings

from splatwizard_core.plugins import remedies

settings.register_profile("patient", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

# Freed memory is kept for the next tensor: else each large one is mapped anew, page by page.
forked_children.keep_freed_memory()
forked_children.leave_files_to_the_system()

# Collections of garbage are 40 % of the time in which ten thousand tests are collected; nothing of that is garbage.
gc.disable()

_threads = torch.get_num_threads()
if cores.JOBS > 1:
    torch.set_num_threads(1)  # until the workers are forked

LONG_FIRST = (
    "tests/test_documented_commands.py",
    "tests/test_strangers.py",
    "tests/test_hostile_plugins.py",
    "tests/test_packages_alone.py",
    "tests/test_plugins_installed.py",
    "tests/test_neighbours.py",
    "tests/test_gaussian_methods.py",
    "splatwizard-core/tests/runs/test_survival.py",
    "tests/test_written_configs.py",
    "tests/test_fuzz_swz.py",
    "splatwizard-core/tests/runs/test_measuring.py",
    "splatwizard-core/tests/cli/test_streams.py",
)
"""The files that take tens of seconds. Begun last, one of them would leave every other worker idle at the end."""


@pytest.fixture(scope="session", autouse=True)
def _fork_fresh_processes() -> Iterator[None]:
    """Fork what `sw run` decodes and evaluates in from one process that has imported torch."""
    with contextlib.nullcontext() if forked_children.are_forked() else forked_children.forking():
        yield


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the long files first, each as a whole; the others keep their order."""
    first = {config.rootpath / name: place for place, name in enumerate(LONG_FIRST)}
    assert all(map(Path.is_file, first)), "LONG_FIRST names a file that is gone"
    items.sort(key=lambda item: first.get(item.path, len(first)))


def pytest_collection_finish() -> None:
    """Collect garbage again, but seldom, and never look at the tests themselves: else it is 5 % of all time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(SELDOM)
    gc.enable()


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """With $TEST_JOBS, run the tests in so many forked processes."""
    option = session.config.option
    if cores.JOBS < 2 or sys.platform != "linux" or option.collectonly or session.testsfailed or not session.items:
        return None
    session.config.pluginmanager.getplugin("terminalreporter").showfspath = False  # files mix
    return run_forked(session, cores.JOBS, _threads) or None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """With `--cov`, count only what tests of the core and of native modules reach: counting takes a fifth more time."""
    plugin = item.config.pluginmanager.getplugin("_cov")
    if plugin is not None and (control := plugin.cov_controller) is not None:
        counts = item.path.relative_to(item.config.rootpath).parts[0].startswith("splatwizard-")
        if counts != control.started:
            (control.resume if counts else control.pause)()
    return (yield)


AS_INSTALLED, remedies._local = remedies._local, lambda found: found[0]


@pytest.fixture
def advice_as_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let messages tell how to install from this checkout; elsewhere tests read them as they are written."""
    monkeypatch.setattr(remedies, "_local", AS_INSTALLED)

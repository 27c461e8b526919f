"""Versions that are noted of a thing: those of libraries too, which register nothing."""

import importlib.metadata
from types import SimpleNamespace

import pytest

from splatwizard_core.plugins import versions
from splatwizard_core.plugins.registry import Entry
from splatwizard_core.plugins.versions import changes, made_by

REQUIRED = {
    "sw-method": ["splatwizard-core>=0.2", "sw-family>=0.2", "numpy", "sw-extra; extra == 'all'"],
    "sw-family": ["Sw_Base>=0.2", "sw-method"],
    "sw-base": [],
}


@pytest.fixture
def plugins(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """One plugin that requires two libraries, the second through the first."""

    def requires(name: str) -> list[str]:
        if name not in REQUIRED:
            raise importlib.metadata.PackageNotFoundError(name)
        return REQUIRED[name]

    versions._libraries.cache_clear()
    monkeypatch.setattr(importlib.metadata, "requires", requires)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.2")
    monkeypatch.setattr(versions, "is_ours", lambda name: name.startswith("sw-"))
    yield SimpleNamespace(plugins=[SimpleNamespace(distribution="sw-method", version="0.3")])
    versions._libraries.cache_clear()


def test_libraries_of_ours_count_whatever_requires_them(plugins: SimpleNamespace):
    entry = Entry("method", "m", "m:m", "", distribution="sw-method", version="0.3")
    assert made_by(plugins, [entry]) == {
        "splatwizard-core": "0.2", "sw-base": "0.2", "sw-family": "0.2", "sw-method": "0.3"
    }  # fmt: skip


def test_versions_that_an_older_release_did_not_note_are_no_change(plugins: SimpleNamespace):
    assert changes(plugins, {"splatwizard-core": "0.2", "sw-method": "0.3"}) == []
    assert changes(plugins, {"sw-method": "0.3", "sw-base": "0.1"}) == ["sw-base 0.1, now 0.2"]

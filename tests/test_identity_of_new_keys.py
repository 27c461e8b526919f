"""A new key that changes nothing leaves every training and cached scene as it is; a changed default does not.

tests/golden/defaults.json holds the defaults of every method, and how often each block has counted a changed one; its
`make_defaults.py` writes it anew.
"""

from __future__ import annotations

import json
from typing import Any, ClassVar

import pytest
from golden.make_defaults import FILE, counts, defaults
from pydantic import BaseModel, create_model

from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.training.identity import DEFAULTS, given_values
from splatwizard_core.training.keys import block_of
from splatwizard_core.training.params import Params, PipelineParams

METHODS = sorted(json.loads(FILE.read_text()))


def grown(cls: type[BaseModel]) -> type[BaseModel]:
    """Return a configuration with a new key in every block, whose default is said to change nothing."""
    fields: dict[str, Any] = {"new_key": (int, 0)}
    for name, field in cls.model_fields.items():
        inner = block_of(field.annotation)
        if inner is not None and isinstance(field.default, BaseModel):
            larger = grown(inner)
            fields[name] = (larger, larger.model_validate(field.default.model_dump()))
    return create_model(cls.__name__, __base__=cls, **fields)


@pytest.mark.parametrize("name", METHODS)
def test_a_new_key_in_every_block_leaves_the_trainings_of_a_method_as_they_are(name: str):
    plugins = load_plugins()
    cls = plugins.methods.load(name)
    larger = grown(cls.Config)
    for preset in cls.PRESETS:
        config = resolve(cls, preset).config
        later = larger.model_validate(config.model_dump())
        assert "new_key" in later.model_dump()
        assert given_values(later, plugins) == given_values(config, plugins)
        told = given_values(later.model_copy(update={"new_key": 1}), plugins)
        assert told == {**given_values(config, plugins), "new_key": 1}


def test_a_new_key_of_the_run_leaves_trainings_as_they_are():
    assert given_values(grown(PipelineParams)()) == given_values(PipelineParams()) == {}


class Inner(Params):
    power: float = 1.0


class Outer(Params):
    inner: Inner = Inner(power=2.0)
    words: list[str] = []
    none: int | None = None


class Changed(Inner):
    DEFAULTS: ClassVar[int] = 1


class Twice(Changed):
    DEFAULTS: ClassVar[int] = 1


class OuterOfChanged(Outer):
    inner: Twice = Twice(power=2.0)


def test_values_that_are_the_defaults_of_a_block_but_not_there_are_told_apart():
    every = [Outer(), Outer(inner=Inner()), Outer(inner=Inner(power=3)), Outer(words=["a"]), Outer(none=0)]
    assert len({json.dumps(given_values(each)) for each in every}) == len(every)
    assert given_values(Outer(inner=Inner(power=2.0), none=None)) == {}


def test_counts_of_changed_defaults_are_told_and_add_up_over_base_classes():
    assert given_values(OuterOfChanged()) == {DEFAULTS: {"inner": 2}}


@pytest.mark.parametrize("name", METHODS)
def test_a_changed_default_is_counted(name: str):
    """If this fails: raise `DEFAULTS` of the block that states the default, say so in CHANGELOG.md, and run
    tests/golden/make_defaults.py."""
    then = json.loads(FILE.read_text())[name]
    cls = load_plugins().methods.load(name).Config
    now, counted = defaults(cls), counts(cls)
    changed = {key for key, value in then["values"].items() if key in now and now[key] != value}
    blocks = {path for path, count in counted.items() if count > then["counts"].get(path, 0)}
    silent = {key for key in changed if not any(not path or key.startswith(f"{path}.") for path in blocks)}
    assert not silent


def test_every_method_of_ours_has_its_defaults_kept():
    from splatwizard_core.plugins.catalogue import is_ours

    plugins = load_plugins()
    ours = {entry.name for entry in plugins.methods if is_ours(entry.distribution)}
    assert set(METHODS) == ours

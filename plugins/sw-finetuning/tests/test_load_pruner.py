"""A pruner by name: with the settings that are meant for it and no other's; what is not there is a wrong key."""

from types import SimpleNamespace

import pytest
from sw_finetuning.pruners import load_pruner

from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.plugins.registry import Registry


class Ours:
    uses_statistics = False

    def __init__(self, power=1.0):
        self.power = power


class Theirs:
    uses_statistics = True


@pytest.fixture
def plugins():
    pruners = Registry("pruner")
    pruners.add("ours", f"{__name__}:Ours", summary="with a setting")
    pruners.add("theirs", f"{__name__}:Theirs", summary="without any")
    pruners.add("broken", f"{__name__}:NoSuchClass", summary="cannot be loaded")
    for _ in range(2):
        pruners.add("clash", f"{__name__}:Ours", summary="claimed twice")
    return SimpleNamespace(pruners=pruners)


def test_settings_go_to_the_pruner_that_they_are_meant_for(plugins):
    settings = {"ours": {"power": 3.0}}
    assert load_pruner(plugins, "ours", settings).power == 3.0
    assert isinstance(load_pruner(plugins, "theirs", settings), Theirs)


def test_without_settings_the_defaults_hold(plugins):
    assert load_pruner(plugins, "ours").power == 1.0


def test_an_unknown_name_is_a_wrong_value_of_the_key_that_names_it(plugins):
    with pytest.raises(ConfigError, match=r"no pruner is called 'our'; did you mean 'ours'\?") as told:
        load_pruner(plugins, "our")
    assert told.value.key == "prune.pruner"
    with pytest.raises(ConfigError, match="installed: broken, ours, theirs") as told:
        load_pruner(plugins, "no-such", key="score.pruner")
    assert told.value.key == "score.pruner"


@pytest.mark.parametrize(("name", "told"), [("broken", "NoSuchClass"), ("clash", "claimed by")])
def test_what_is_there_but_cannot_be_loaded_is_no_matter_of_the_config(plugins, name, told):
    with pytest.raises(PluginError, match=told):
        load_pruner(plugins, name)

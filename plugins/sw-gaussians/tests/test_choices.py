"""A codec or a pruner by name, with the settings of who provides it: what is parsed, refused, dropped and migrated."""

from types import SimpleNamespace
from typing import ClassVar, Literal

import pytest
from pydantic import Field
from sw_gaussians.choices import Choice, Choosing, CodecChoice, Moved, OwnCodec, PrunerChoice
from sw_gaussians.named_blocks import SWITCH

from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.plugins.registry import Coders, Registry
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.training.identity import given_values
from splatwizard_core.training.params import Params


class Inner(Params):
    depth: int = Field(3, ge=1, description="how deep")


class OurSettings(Params):
    power: float = Field(1.0, ge=0, description="exponent")
    word: str = "one"
    steps: list[int] = [1, 2]
    inner: Inner = Inner()


class Ours:
    Settings = OurSettings
    uses_statistics = False

    def __init__(self, *plugins, power=1.0, word="one", steps=(1, 2), inner=None):
        self.power, self.word, self.steps, self.inner = power, word, steps, inner


class Theirs:
    """Without settings."""

    uses_statistics = True

    def __init__(self, *plugins):
        pass


class NoDefault(Theirs):
    class Settings(Params):
        power: float


class NoModel(Theirs):
    Settings: ClassVar[dict[str, int]] = {"power": 1}


class Prune(PrunerChoice):
    pruner: str = Field("ours", description="whose scores")
    share: float = Field(0.5, ge=0, lt=1, description="how much")


class PartsChoice(Choice):
    REGISTRY: ClassVar[str] = "gaussian_codecs"
    PARTS: ClassVar[tuple[str, ...]] = ("low", "high")

    name: str = "ours"
    settings: dict[str, object] = {}
    low: dict[str, object] = {"power": 0.5}
    high: dict[str, object] = {}


class FileSettings(Params):
    bits: int = Field(8, ge=1, description="bits")


class Own(OwnCodec):
    name: Literal["toy"] = "toy"
    settings: FileSettings = FileSettings()


class Config(Choosing):
    OLDER: ClassVar[dict[str, Moved]] = {
        "codec": Moved(("codec.name",)),
        "prune.exponent": Moved(("prune.settings.power",), 1.0, "ours"),
        "parts.both": Moved(("parts.low.power", "parts.high.power"), 0.5, "ours"),
        "vq.bits": Moved(("own.settings.bits",), 8),
    }

    prune: Prune = Prune()
    codec: CodecChoice = CodecChoice(name="ours")
    own: Own = Own()
    parts: PartsChoice = PartsChoice()


@pytest.fixture
def plugins():
    pruners, coders = Registry("pruner"), Registry("coder")
    for registry, declared in ((pruners, {}), (coders, {"codes": "gaussians"})):
        for name, cls in (("ours", "Ours"), ("theirs", "Theirs"), ("no-default", "NoDefault"), ("no-model", "NoModel")):
            registry.add(name, f"{__name__}:{cls}", summary="", **declared)
        registry.add("broken", f"{__name__}:NoSuchClass", summary="cannot be loaded", **declared)
        for _ in range(2):
            registry.add("clash", f"{__name__}:Ours", summary="claimed twice", **declared)
    coders.add("range", f"{__name__}:Theirs", summary="an entropy coder", codes="symbols")
    return SimpleNamespace(pruners=pruners, coders=coders, gaussian_codecs=Coders(coders, "gaussians"))


@pytest.fixture
def config(plugins):
    """config(*layers, **values) -> Config with the values of each layer by dotted key, `__` for the dot."""

    def make(*layers, **values):
        made = Config()
        for layer in (*layers, {key.replace("__", "."): value for key, value in values.items()}):
            made = apply_overrides(made, layer, source="--set")
        return made.completed(plugins, {"codec.settings.power": "some file", "prune.settings.power": "--set"})

    return make


FULL = {"power": 1.0, "word": "one", "steps": [1, 2], "inner": {"depth": 3}}


def test_text_is_parsed_by_the_types_of_the_provider_and_every_setting_is_there(config):
    made = config(prune__settings__power="3e-1", prune__settings__word="7", prune__settings__steps="4,5")
    assert made.prune.settings == {**FULL, "power": 0.3, "word": "7", "steps": [4, 5]}
    assert config().codec.settings == FULL
    assert config(codec__settings__inner__depth="5").codec.settings["inner"] == {"depth": 5}


def test_the_name_alone_stands_for_the_block(config):
    for values in ({"codec": "theirs"}, {"codec.name": "theirs"}, {"codec": {"name": "theirs"}}):
        made = config(values)
        assert (made.codec.name, made.codec.settings) == ("theirs", {})
    assert Config(codec="theirs").codec.name == "theirs"
    both = {"codec.settings.power": "2", "codec": "ours"}
    assert config({"codec": "theirs"}, both).codec.settings["power"] == 2
    assert config({"codec": {"settings": {"power": 2}}}).codec.settings == {**FULL, "power": 2.0}


def test_another_provider_starts_without_the_settings_of_the_one_before(config):
    layers = {"codec.settings.power": "2"}, {"codec": "theirs"}
    assert config(*layers).codec.settings == {}
    assert config(*layers, {"codec": "ours"}).codec.settings == FULL
    assert config({"codec.settings.power": "2"}, {"codec": "ours"}).codec.settings["power"] == 2


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("codec.settings.pover", "1", r"unknown key 'codec.settings.pover' .*did you mean 'codec.settings.power'\?"),
        ("codec.settings.power", "-1", r"-1' for 'codec.settings.power' in some file: must be greater .*\(exponent\)"),
        ("codec.settings.power", "much", r"'much' for 'codec.settings.power' in some file: expected a number"),
        ("prune.settings.steps", "1,x", "'1,x' for 'prune.settings.steps' .*: expected a whole number"),
        ("prune.seting", "1", "unknown key 'prune.seting'"),
        ("own.name", "theirs", "expected one of toy"),
        ("own.settings.bit", "1", r"did you mean 'own.settings.bits'\?"),
        ("parts.low.pover", "1", r"did you mean 'parts.low.power'\?"),
    ],
)
def test_a_wrong_setting_is_told_with_its_full_key(config, key, value, told):
    with pytest.raises(ConfigError, match=told) as error:
        config({key: value})
    assert error.value.key == key


def test_an_unknown_setting_is_told_with_whose_settings_there_are(config):
    told = r"'codec.settings.power'\?\nThese are the settings of 'ours' \(codec.name\): `--set codec=NAME` chooses"
    with pytest.raises(ConfigError, match=told):
        config(codec__settings__pover="1")
    with pytest.raises(ConfigError, match=r"of 'ours' \(prune.pruner\): `--set prune=NAME`"):
        config(prune__settings__pover="1")
    with pytest.raises(ConfigError) as bad_value:
        config(codec__settings__power="-1")
    assert "NAME" not in str(bad_value.value)


def test_a_provider_without_settings_says_so(config):
    told = r"'prune.settings.power' in --set: 'theirs' \(prune.pruner\) has no settings: leave it out"
    with pytest.raises(ConfigError, match=told):
        config(prune__pruner="theirs", prune__settings__power="1")


def test_an_unknown_name_is_a_wrong_value_of_the_key_that_names_it(config, plugins):
    with pytest.raises(ConfigError, match=r"no pruner is called 'our'; did you mean 'ours'\?") as told:
        config(prune__pruner="our")
    assert told.value.key == "prune.pruner"
    with pytest.raises(ConfigError, match=r"'range' does not code gaussians; those that do: .*ours") as told:
        config(codec="range")
    assert told.value.key == "codec.name"
    with pytest.raises(ConfigError, match="no pruner is called 'zzz'") as told:
        Prune(pruner="zzz").load(plugins, "score.pruner")
    assert told.value.key == "score.pruner"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("broken", "NoSuchClass"), ("clash", "claimed by"), ("no-default", "fields have defaults"),
        ("no-model", "a pydantic model"),
    ],
)  # fmt: skip
def test_what_is_there_but_broken_is_no_matter_of_the_config(config, name, told):
    with pytest.raises(PluginError, match=told):
        config(prune__pruner=name)


def test_it_is_made_with_its_settings(config, plugins):
    made = config(prune__settings__power="3", codec__settings__power="2")
    assert made.prune.load(plugins).power == 3
    assert made.codec.load(plugins).power == 2
    assert isinstance(config(prune__pruner="theirs").prune.load(plugins), Theirs)
    assert Prune().load(plugins).power == 1, "a config that was never completed leaves it to the constructor"


def test_settings_of_a_part_stay_those_that_are_given(config):
    made = config(parts__settings__power="2", parts__high__word="two")
    assert made.parts.settings == {**FULL, "power": 2.0}
    assert (made.parts.low, made.parts.high) == ({"power": 0.5}, {"word": "two"})
    assert config(parts="theirs").parts.low == {}


def test_older_keys_mean_what_they_meant(config):
    made = config({"codec": "theirs", "prune.exponent": "3", "vq": {"bits": 4}, "parts.both": 0.75})
    assert made.codec.name == "theirs"
    assert made.prune.settings["power"] == 3
    assert made.own.settings.bits == 4
    assert made.parts.low == made.parts.high == {"power": 0.75}


def test_an_older_setting_of_another_provider_is_left_out_as_it_was(config):
    assert config({"prune.pruner": "theirs", "prune.exponent": "3"}).prune.settings == {}
    assert config({"prune.pruner": "theirs"}, {"prune.exponent": "3"}).prune.settings == {}


@pytest.mark.parametrize("value", ["true", False, "off", "0"])
def test_a_switch_between_two_ways_to_one_result_is_gone_quietly(value):
    assert Moved((), SWITCH).checked("graphs", value) == value


def test_nonsense_for_a_switch_that_is_gone_is_refused():
    with pytest.raises(ConfigError, match=r"'graphs' is gone since 0\.3, with what maybe did: leave it out"):
        Moved((), SWITCH).checked("graphs", "maybe")


def test_an_older_key_that_never_was_is_unknown(config):
    with pytest.raises(ConfigError, match=r"unknown key 'vq\.bit'"):
        config({"vq.bit": 3})


def test_settings_that_are_the_defaults_of_a_provider_identify_nothing(config, plugins):
    assert given_values(config(), plugins) == {}
    assert given_values(config(prune__settings__word="x"), plugins)["prune"] == {"settings": {"word": "x"}}


def test_what_identifies_a_training_tells_every_choice_apart(config, plugins):
    made = [
        config(), config(codec__settings__power="2"), config(codec="theirs"), config(prune__settings__word="x"),
        config(parts__low__power="0.1"), config(parts__high__power="0.1"), config(own__settings__bits="1"),
    ]  # fmt: skip
    contents = [str(given_values(each, plugins)) for each in made]
    assert len(set(contents)) == len(contents)

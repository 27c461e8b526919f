"""Configuration: the order of its layers, the parsing of text, and what is said of typos."""

from dataclasses import replace
from enum import Enum
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from splatwizard_core.base.values import parse_text
from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.method import Method, create_method
from splatwizard_core.plugins.registry import Registry
from splatwizard_core.runs.config import parse_set, rate_points, resolve
from splatwizard_core.training.overrides import apply_overrides
from splatwizard_core.training.params import OptimizationParams, Params


class Densify(Params):
    grad_threshold: float = Field(2e-4, gt=0, description="NDC units")
    screen_px: float | None = 20.0


class Codec(Params):
    mode: Literal["exact", "quantized"] = "exact"
    bits: dict[str, int] = {"means": 16}


class Part(Params):
    size: int
    word: str = Field("a", min_length=1)


class Config(OptimizationParams):
    steps: list[int] = [1, 2]
    parts: list[Part] = []
    densify: Densify = Densify()
    codec: Codec = Codec()


class Toy(Method):
    name = "toy"
    Config = Config
    PRESETS = {"paper": {}, "quick": {"iterations": 100, "clamp_render": True}}
    RATES = {
        "r1": {"codec.mode": "quantized", "codec.bits.means": 8},
        "r2": {"codec.mode": "quantized"},
        "r3": {},
    }
    DEFAULT_RATE = "r3"


def resolved(*sets: str, **options: Any):
    return resolve(
        Toy,
        options.pop("preset", None),
        options.pop("rate", None),
        options.pop("file", None),
        parse_set(sets),
        **options,
    )


def test_each_layer_wins_over_the_one_before(tmp_path: Path):
    file = tmp_path / "c.toml"
    file.write_text("iterations = 200\n[densify]\ngrad_threshold = 0.5\n")
    assert resolved(scene="x").config.iterations == 30_000
    assert resolved(scene="x", preset="quick").config.iterations == 100
    assert resolved(scene="x", preset="quick", file=file).config.iterations == 200
    both = resolved("iterations=300", scene="x", preset="quick", rate="r1", file=file)
    assert both.config.iterations == 300
    assert both.config.densify.grad_threshold == 0.5
    assert both.config.codec.bits == {"means": 8}
    assert both.provenance["iterations"] == "--set"
    assert both.provenance["densify.grad_threshold"] == str(file)
    assert both.provenance["codec.mode"] == "rate 'r1'"
    assert both.provenance["clamp_render"] == "preset 'quick'"


def test_a_file_of_names_is_told_by_its_whole_path_and_no_file_stands_in_for_a_rule(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("all", "file", "held_out.txt"):
        Path(name).write_text("a.png")
    assert [resolved(f"split={name}").scene.split for name in ("all", "file", "every8")] == ["all", "file", "every8"]
    for name in ("held_out.txt", "~/held_out.txt"):
        assert resolved(f"split={name}").scene.split == str(tmp_path / "held_out.txt")
    assert resolved("split=~nobody-of-this-name/list.txt").scene.split == "~nobody-of-this-name/list.txt"


def test_a_file_of_names_counts_by_what_it_holds_not_by_where_it_lies(tmp_path):
    hashes = []
    for folder, names in (("a", "1.png"), ("b", "1.png"), ("c", "2.png")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "test.txt").write_text(names)
        found = resolved(f"split={tmp_path / folder / 'test.txt'}")
        hashes.append((found.config_hash(), found.training_hash()))
    assert hashes[0] == hashes[1]
    assert not set(hashes[0]) & set(hashes[2])


def test_the_demo_scene_means_the_quick_preset_and_any_other_the_paper():
    assert resolved().preset == "quick"
    assert resolved(scene="demo:tiny").preset == "quick"
    assert resolved(scene="garden").preset == "paper"
    assert resolved(preset="paper").preset == "paper"


def test_keys_go_to_method_run_and_scene_options():
    found = resolved(
        "densify.screen_px=none", "raster.prefer=a,b", "seed=7", "resolution=4", "test_every=5", "split=all"
    )
    assert found.config.densify.screen_px is None
    assert found.ppl.raster.prefer == ["a", "b"]
    assert found.ppl.seed == found.scene.seed == 7
    assert (found.scene.resolution, found.scene.test_every, found.scene.split) == (4, 5, "all")


def test_equal_bits_on_a_gpu_are_another_training():
    plain, same = resolved(scene="x"), resolved("deterministic=true", scene="x")
    assert "deterministic" not in plain.training_content()["pipeline"]
    assert resolved("deterministic=false", scene="x").config_hash() == plain.config_hash()
    assert same.ppl.deterministic
    assert same.training_content()["pipeline"]["deterministic"] is True
    assert same.training_hash() != plain.training_hash()


def test_options_of_rasterizers_that_are_decided_are_another_training():
    plain, decided = resolved(scene="x"), resolved("raster.antialias=true", "raster.eps2d=0.1", scene="x")
    assert plain.training_content()["pipeline"] == {}
    assert plain.ppl.raster.options == {}
    assert decided.ppl.raster.options == {"antialias": True, "eps2d": 0.1}
    assert decided.training_hash() != plain.training_hash()
    assert resolved("raster.antialias=none", "raster.profile=none", scene="x").config_hash() == plain.config_hash()
    assert resolved("raster.antialias=false", scene="x").ppl.raster.options == {"antialias": False}
    for wrong in ("raster.eps2d=-1", "raster.eps2d=nan", "raster.antialias=2"):
        with pytest.raises(ConfigError, match="raster"):
            resolved(wrong, scene="x")


def test_the_written_file_makes_the_same_configuration(tmp_path: Path):
    first = resolved(
        "densify.screen_px=none", "steps=3,4,5", "background=white", rate="r1", preset="quick", scene="demo:tiny"
    )
    file = tmp_path / "config.toml"
    file.write_text(first.toml())
    again = resolve(Toy, config_file=file)
    assert {**again.as_dict(), "provenance": None} == {**first.as_dict(), "provenance": None}
    assert again.scene_spec == first.scene_spec
    assert again.config_hash() == first.config_hash()
    assert again.training_hash() == first.training_hash()


class Rate(Params):
    weight: float = 0.001


class HidesTheRate(OptimizationParams):
    rate: Rate = Rate()


class HidesMore(OptimizationParams):
    seed: int = 0
    images: str = ""
    pretrained: Rate = Rate()
    init: str = ""  # this one a method may have: it means its own


@pytest.mark.parametrize(
    ("config", "names"), [(HidesTheRate, "'rate'"), (HidesMore, "'seed' and 'images' and 'pretrained'")]
)
def test_a_method_whose_keys_hide_those_of_a_run_is_refused_by_name(config: type[OptimizationParams], names: str):
    class TheirMethod(Method):
        name = "theirs"
        Config = config

    with pytest.raises(PluginError) as caught:
        resolve(TheirMethod)
    assert str(caught.value) == (
        f"method 'theirs' cannot be used: its {config.__name__} ({__name__}) has a key {names}, as every run has; "
        "its author must choose another name"
    )


def test_a_written_file_refuses_another_rate_point_instead_of_ignoring_it(tmp_path: Path):
    file = tmp_path / "config.toml"
    file.write_text(resolved(rate="r1").toml())
    with pytest.raises(ConfigError, match=r"written for rate 'r1', not 'r2'"):
        resolved(rate="r2", file=file)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, capsys):
    """(choices) -> the configurations of a training session of a scene with 1,000 x 1,000 pixels, and what was said."""
    from splatwizard_core.cli import setup

    plugins = SimpleNamespace(methods=SimpleNamespace(entry=lambda name: SimpleNamespace(name=name, declared={})))

    def open_it(found, side: int = 1000, **chosen):
        camera = SimpleNamespace(width=side, height=side)
        scene = SimpleNamespace(train=[SimpleNamespace(camera=camera)])
        session = SimpleNamespace(device="cpu", scene=lambda each: scene)
        monkeypatch.setattr(setup, "open_session", lambda resolved, plugins: session)
        monkeypatch.setattr("splatwizard_core.runs.device.device_reason", lambda *arguments: "on the CPU")
        monkeypatch.setattr(setup.Choices, "resolve", lambda choices, plugins: found(choices.preset))
        configurations, _ = setup.open_training_session(setup.Choices(**chosen), plugins)
        return configurations, capsys.readouterr().err.splitlines()

    return open_it


def test_rate_points_whose_values_are_all_overridden_are_told(opened):
    _, told = opened(lambda preset: [resolved(rate=r) for r in ("r1", "r2", "r3")])
    assert told == ["on the CPU"]
    _, told = opened(lambda preset: [resolved("codec.mode=exact", "codec.bits.means=4", rate=r) for r in ("r1", "r3")])
    assert told[0].startswith("warning: toy r1, r3: these rate points give the same file")
    assert told[1:] == ["on the CPU"]


@pytest.mark.parametrize(
    ("side", "sets", "chosen", "preset"),
    [
        (100, (), {}, "quick"),
        (1000, (), {}, "paper"),
        (100, (), {"preset": "paper"}, "paper"),
        (100, ("iterations=5",), {}, "paper"),  # who says how long knows what they want
        (100, (), {"config_file": "config.toml"}, "paper"),
    ],
)
def test_a_tiny_scene_gets_the_quick_plan_unless_something_else_is_asked_for(opened, side, sets, chosen, preset):
    (found,), told = opened(lambda asked: [resolved(*sets, preset=asked or "paper")], side, **chosen)
    assert found.preset == preset
    assert told[:-1] == (
        ["preset quick: the plan scaled down for 10,000 training pixels (--preset paper runs it in full)"]
        if preset == "quick"
        else []
    )


def test_values_by_data_set_are_told_once_for_each_method(opened):
    def found(preset):
        sources = dict.fromkeys(("steps", "pretrained.density.cap"), "data set 'db'")
        by_data_set = [replace(resolved(rate=r), method=m, provenance=sources, pretrained={"density.cap": 7})
                       for m in ("one", "other") for r in ("r1", "r2")]  # fmt: skip
        return [resolved(preset="paper"), *by_data_set]

    _, told = opened(found)
    assert told[-3:] == [
        *(f"{m}, by data set: steps = [1, 2], pretrained.density.cap = 7" for m in ("one", "other")), "on the CPU"
    ]  # fmt: skip
    assert not any("by data set" in line for line in told[:-3])
    _, told = opened(lambda preset: [resolved(preset=preset)] if preset else found(preset), side=100)
    assert not any("by data set" in line for line in told)


def test_rate_points_that_differ_only_in_the_codec_train_alike():
    hashes = {resolved(rate=r).training_hash() for r in ("r1", "r2", "r3")}
    assert len(hashes) == 1
    assert len({resolved(rate=r).config_hash() for r in ("r1", "r2", "r3")}) == 3
    assert resolved("iterations=5").training_hash() not in hashes
    assert resolved("seed=1").training_hash() not in hashes
    assert resolved("background=white").training_hash() not in hashes


def test_rate_aliases():
    assert rate_points(Toy, "low") == ["r1"]
    assert rate_points(Toy, "high") == ["r3"]
    assert rate_points(Toy, "default") == ["r3"]
    assert rate_points(Toy, "all") == ["r1", "r2", "r3"]
    assert rate_points(Toy, "r3, r1,low") == ["r1", "r3"]
    with pytest.raises(ConfigError, match="no rate point 'r9': one of r1, r2, r3, or low"):
        rate_points(Toy, "r9")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            "densify.grad_treshold=1",
            "unknown key 'densify.grad_treshold' in --set: did you mean 'densify.grad_threshold'?",
        ),
        ("grad_threshold=1", "did you mean 'densify.grad_threshold'"),
        ("iteration=1", "did you mean 'iterations'"),
        ("resolutoin=1", "did you mean 'resolution'"),
        ("size=5MB", "takes no size: unlike "),
        ("seeed=1", "did you mean 'seed'"),
        ("qqq=1", r"unknown key 'qqq' in --set: the keys are .*densify"),
        ("densify.grad_threshold=-1", r"bad value '-1' for 'densify.grad_threshold' in --set: must be greater than 0"),
        ("densify.grad_threshold=x", r"bad value 'x' for 'densify.grad_threshold' in --set: expected a number"),
        ("densify.grad_threshold=inf", "must be a finite number"),
        ("densify.grad_threshold=nan", "bad value 'nan' for 'densify.grad_threshold' in --set"),
        ("iterations=0", r"bad value '0' for 'iterations' in --set: must be greater than or equal to 1"),
        ("threads=1000000", r"bad value '1000000' for 'threads' in --set: must be less than or equal to 1024"),
        ("iterations=1.5", "expected a whole number"),
        ("codec.mode=lossy", "expected one of exact, quantized"),
        ("densify=1", "this is a block"),
        ("device=gpu", "expected one of auto, cpu, cuda"),
        ("resolution=big", "expected a whole number"),
    ],
)
def test_wrong_input_is_named_with_what_to_do(setting: str, message: str):
    with pytest.raises(ConfigError, match=message) as caught:
        resolved(setting)
    assert caught.value.exit_status == 2
    assert "\n" not in str(caught.value)


def test_set_needs_an_equals_sign():
    with pytest.raises(ConfigError, match="--set needs key=value, got 'iterations'"):
        parse_set(["iterations"])


def test_an_unknown_preset_lists_those_there_are():
    with pytest.raises(ConfigError, match="no preset 'fast': one of paper, quick"):
        resolved(preset="fast")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("iterations = ", "not valid TOML"),
        ("iteration = 3", r"unknown key 'iteration' in .*c.toml: did you mean 'iterations'"),
        ("[densify]\ngrad_treshold = 1", r"unknown key 'densify.grad_treshold' in .*c.toml"),
        ("iterations = 'many'", r"bad value 'many' for 'iterations' in .*c.toml"),
        ("seed = 2.0", r"bad value 2.0 for 'seed' in .*c.toml: must be a valid integer"),
        ("parts = [{}]", r"c.toml: 'parts.0.size' is missing"),
        ("parts = [{ size = 1, sise = 2 }]", r"for 'parts' in .*c.toml: must be left out: there is no such key"),
        ("parts = [{ size = 1, word = '' }]", r"for 'parts' in .*c.toml: must be a text that is not empty"),
        (f"iterations = {10**26}", "bad value '1000.*' for 'iterations' in .*: an integer does not fit 64 bits"),
        ("iterations = 1e26", "bad value 1e.26 for 'iterations' in .*: must be a whole number that fits 64 bits"),
        (f"iterations = {10**10}", "bad value 10000000000 for 'iterations' in .*: must be less than or equal to 10000"),
        (f"x = {'[' * 100_000}", "c.toml is not valid TOML here: its brackets are nested too deeply"),
        ("a." * 50_000 + "a = 1", r"c.toml is not valid TOML: line 1 has a key of more than 32 parts"),
        ("method = 5", r"bad value 5 for 'method' in .*c.toml: expected a name"),
        ("rate = ['r1']", r"bad value \['r1'\] for 'rate' in .*c.toml: expected a name"),
        ("scene = ''", r"bad value '' for 'scene' in .*c.toml: expected a name"),
        ("method = 'other'", r"written for method 'other', not 'toy'"),
    ],
)
def test_a_wrong_file_is_named(tmp_path: Path, content: str, message: str):
    file = tmp_path / "c.toml"
    file.write_text(content)
    with pytest.raises(ConfigError, match=message):
        resolved(file=file)


def test_keys_of_an_older_release_are_told_with_those_of_today_where_the_user_gives_them(caplog):
    class Moved(Config):
        def spelled(self, values):
            return {{"old": "densify.grad_threshold"}.get(key, key): value for key, value in values.items()}

    class Newer(Toy):
        Config = Moved
        PRESETS = {"paper": {"old": 3.0}, "quick": {}}

    assert resolve(Newer, "paper").config.densify.grad_threshold == 3.0
    assert caplog.messages == []
    for _ in range(2):
        assert resolve(Newer, sets={"old": 4.0, "seed": 1}).config.densify.grad_threshold == 4.0
    assert caplog.messages == ["--set: old of release 0.2 is now densify.grad_threshold (docs/migration.md)"]


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"nothing\.toml"):
        resolved(file=tmp_path / "nothing.toml")


class Colour(Enum):
    RED = "red"


@pytest.mark.parametrize(
    ("annotation", "text", "value"),
    [
        (bool, "yes", True), (bool, "0", False), (int, "30_000", 30_000), (int, "3e4", 30_000), (float, "1e-3", 1e-3),
        (float | None, "none", None), (float | None, "2", 2.0), (str | None, "none", None), (str, "none", "none"),
        (list[int], "1,2", [1, 2]), (list[int], "[1, 2]", [1, 2]), (list[str], "", []),
        (list[str], "['a', b]", ["a", "b"]),
        (tuple[int, str], "1,a", [1, "a"]), (tuple[float, ...], "1,2,3", [1.0, 2.0, 3.0]),
        (list[tuple[int, int]], "(1,2),(3,4)", [[1, 2], [3, 4]]),
        (Literal["a", 3], "3", 3), (Colour, "red", Colour.RED), (Colour, "RED", Colour.RED),
        (Annotated[int | str, "x"], "5", 5), (int | str, "five", "five"), (dict[str, int], '{"a": 1}', {"a": 1}),
        (Any, "[1]", [1]), (Any, "word", "word"),
    ],
)  # fmt: skip
def test_text_is_parsed_by_the_fields_type(annotation: Any, text: str, value: Any):
    assert parse_text(annotation, text) == value


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(), st.lists(st.integers(), max_size=5))
def test_what_python_prints_is_parsed_back(x: float, n: int, numbers: list[int]):
    assert parse_text(float, repr(x)) == x
    assert parse_text(int, str(n)) == n
    assert parse_text(list[int], str(numbers)) == numbers


def test_overrides_leave_the_original_alone():
    config = Config()
    changed = apply_overrides(config, {"densify.grad_threshold": 1.0, "codec.bits.sh": 4}, source="test")
    assert changed.densify.grad_threshold == 1.0
    assert changed.codec.bits == {"means": 16, "sh": 4}
    assert config == Config()


def test_a_borrowed_preset_leaves_the_keys_of_the_run_to_the_run():
    class Registry:
        def load(self, name: str) -> type[Method]:
            return Borrowed

    class Manager:
        methods = Registry()

    class Borrowed(Toy):
        PRESETS = {"paper": {}, "quick": {}, "old": {"clamp_render": True, "test_every": 4, "iterations": 77}}

    assert create_method(Manager(), "toy", preset="old").config.iterations == 77  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="clamp_render"):
        create_method(Manager(), "toy", {"clamp_render": True})  # type: ignore[arg-type]


class Borrowing(OptimizationParams):
    ENCODING = ("file", "order")
    base: dict[str, Any] = {}
    file: Codec = Codec()
    order: str = "morton"


class Borrower(Method):
    name = "borrower"
    Config = Borrowing


def test_keys_of_a_borrowed_method_go_as_deep_as_it_has_blocks():
    sets = {"base.densify.start": "600", "base.preset": "inria", "base.lr.means.init": "1.5e-4"}
    assert resolve(Borrower, sets=sets).config.base == {
        "densify": {"start": 600}, "preset": "inria", "lr": {"means": {"init": 1.5e-4}},
    }  # fmt: skip


def test_a_method_says_which_fields_only_its_encoder_reads():
    plain = resolve(Borrower)
    for sets in ({"file.mode": "quantized"}, {"order": "hilbert"}):
        assert resolve(Borrower, sets=sets).training_hash() == plain.training_hash()
    assert resolve(Borrower, sets={"base.densify.start": "600"}).training_hash() != plain.training_hash()


class LpipsLike(Params):
    weights: Path | None = None
    layers: int = Field(5, ge=1)


@pytest.fixture
def with_settings(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Plugins with two metrics of one group of settings, and a scene that is made on the spot."""
    metrics, datasets = Registry("metric"), Registry("dataset")
    for name in ("deep_a", "deep_b"):
        metrics.add(name, "nowhere:x", summary="", group="deep", settings=f"{__name__}:LpipsLike")
    datasets.add("clouds", "nowhere:x", summary="", procedural=True)
    return SimpleNamespace(metrics=metrics, datasets=datasets)


def test_settings_of_metrics_come_by_key_and_file_and_are_checked(with_settings: SimpleNamespace, tmp_path: Path):
    file = tmp_path / "c.toml"
    file.write_text(f'[metrics.deep]\nweights = "{tmp_path}"\nlayers = 2\n')
    found = resolved("metrics.deep.layers=3", file=file, scene="x", plugins=with_settings)
    assert found.metrics == {"deep": {"weights": str(tmp_path), "layers": 3}}
    assert found.provenance["metrics.deep.layers"] == "--set"
    file.write_text(found.toml())
    assert resolve(Toy, config_file=file, plugins=with_settings).metrics == found.metrics
    assert found.as_dict()["metrics"] == found.metrics
    for wrong, told in {
        "metrics.deep.layer=1": "did you mean 'metrics.deep.layers'",
        "metrics.deep.layers=0": "'metrics.deep.layers'",
        "metrics.shallow.x=1": "unknown key 'metrics.shallow.x'",
        "metrics.deep=1": "unknown key 'metrics.deep'",
    }.items():
        with pytest.raises(ConfigError, match=told):
            resolved(wrong, scene="x", plugins=with_settings)


def test_settings_of_metrics_leave_the_hash_of_a_run_as_it_is(with_settings: SimpleNamespace):
    plain = resolved(scene="x", plugins=with_settings)
    assert "metrics" not in plain.as_dict()
    assert "metrics" not in plain.toml()
    tuned = resolved("metrics.deep.layers=3", scene="x", plugins=with_settings)
    assert (tuned.config_hash(), tuned.training_hash()) == (plain.config_hash(), plain.training_hash())


def test_a_scene_that_is_made_on_the_spot_is_one_by_declaration(with_settings: SimpleNamespace):
    clouds = resolved(scene="clouds:small", plugins=with_settings)
    assert (clouds.procedural, clouds.preset, clouds.absolute_scene) == (True, "quick", "clouds:small")
    assert not resolved(scene="demo", plugins=with_settings).procedural
    assert resolved(plugins=with_settings).scene_spec == "", "no package of ours declares a default"

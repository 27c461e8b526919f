"""Every check can fail: on something that does not keep the contract, with a reason and what mends it."""

from __future__ import annotations

import sys
import types

import pytest
import torch
from sw_kit.checks import rate_points, registration
from sw_kit.checks.behaviour import BEHAVIOUR
from sw_kit.checks.coding import hold_cuts
from sw_kit.checks.fields import check_entry
from sw_kit.checks.methods import check_configuration
from sw_kit.checks.published import check_published
from sw_kit.checks.rate_points import check_rate_points
from sw_kit.checks.small_run import _check_encoding, _lengths
from sw_kit.checks.targets import check_target
from sw_kit.finding import BrokenContractError, NotCheckedError, PackageCheck
from sw_kit.samples import some_gaussians
from sw_kit.suite import checks_of

from splatwizard_core.api import (
    BitstreamError,
    ConfigError,
    DensityControl,
    Method,
    MetricResult,
    OptimizationParams,
    Params,
    Stage,
    UserInputError,
)
from splatwizard_core.tooling import Entry, PluginInfo, load_plugins

PLUGINS = load_plugins()


@pytest.fixture
def entry_of(monkeypatch):
    """entry_of(kind, target, **declared): an entry whose target is this object."""

    def make(kind, target, **declared):
        module = types.ModuleType("sw_bad_things")
        module.target = target
        monkeypatch.setitem(sys.modules, "sw_bad_things", module)
        return Entry(kind, "bad-thing", "sw_bad_things:target", "one line", declared, "sw-bad", "0.1")

    return make


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """installed(source, requires): a distribution sw-bad with one module sw_bad."""

    def make(source, requires=("splatwizard-core>=0.3,<0.4",)):
        (tmp_path / "sw_bad.py").write_text(source)
        info = tmp_path / "sw_bad-0.1.dist-info"
        info.mkdir()
        lines = "".join(f"Requires-Dist: {line}\n" for line in requires)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: sw-bad\nVersion: 0.1\n{lines}\n")
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{':'.join(filter(None, sys.path))}")
        return PluginInfo("bad", "sw-bad", "0.1", "sw_bad")

    return make


class Halves:
    """A codec of Gaussians in two packets."""

    cuts = True

    def __init__(self, plugins):
        pass

    def encode(self, model, writer):
        table = torch.cat([each.detach().flatten(1) for each in model.parameters() if each.ndim > 1], 1).numpy()
        for number, rows in enumerate((table[: len(table) // 2], table[len(table) // 2 :])):
            writer.add_array(f"part{number}", rows)
            if self.cuts:
                writer.cut()

    def rows(self, reader):
        return sum(len(reader.array(name, dtype="f4")) for name in list(reader.sections))

    def decode(self, reader):
        found = some_gaussians()
        mask = torch.arange(found.num_rows) < self.rows(reader)
        return type(found)(**{name: each.detach()[mask] for name, each in found.named_parameters()})


class Undeclared(Halves):
    """It has cuts whatever its entry says."""


class Whole(Halves):
    """It has none."""

    cuts = False


class Peeping(Halves):
    """Its decoder makes something of the file's name."""

    def rows(self, reader):
        return super().rows(reader) - (reader.name == "cut file" and reader.packets < 2)


class Shrinking(Halves):
    """Its second packet takes away what the first one brought."""

    def rows(self, reader):
        return super().rows(reader) // reader.packets**2


class Careless(Halves):
    """It asks for the first section alone."""

    def rows(self, reader):
        return len(reader.array("part0", dtype="f4"))


@pytest.mark.parametrize(
    ("codec", "declared", "said"),
    [
        (Undeclared, {}, "file has cuts, which its entry does not say"),
        (Whole, {"prefixes": ""}, "has 0 cuts with the setting"),
        (Peeping, {"prefixes": ""}, "after packet 1 decodes to another model"),
        (Shrinking, {"prefixes": ""}, "packets take away"),
        (Careless, {"prefixes": ""}, "section 'part1': method 'check' knows no such section"),
    ],
)
def test_cuts_that_are_no_exact_prefixes_are_told(entry_of, codec, declared, said):
    entry = entry_of("coder", codec, codes="gaussians", **declared)
    with pytest.raises((BrokenContractError, BitstreamError), match=said):
        hold_cuts(entry, codec, PLUGINS)


def test_exact_prefixes_are_counted(entry_of):
    n = some_gaussians().num_rows
    told = hold_cuts(entry_of("coder", Halves, codes="gaussians", prefixes=""), Halves, PLUGINS)
    assert told == f"2 prefixes of {n // 2} to {n} rows are exact"


HOOK = """
from splatwizard_core.api import hookimpl

@hookimpl
def register_methods(registry):
    {}
"""


@pytest.mark.parametrize(
    ("line", "said"),
    [("import sys; sys.modules['torch'] = sys", "imports torch"),
     ("print('hello')", "prints 'hello'"), ("1 / 0", "ZeroDivisionError"),
     ("for _ in range(30_000):\n        pass", r"executes 6\d,\d{3} lines of Python, at most 50,000"),
     ("import numpy", "lines of Python")],
)  # fmt: skip
def test_registration_that_is_not_light(installed, line, said):
    with pytest.raises(BrokenContractError, match=said):
        registration.check_light(installed(HOOK.format(line)))


@pytest.mark.parametrize(
    ("requires", "said"),
    [((), "does not require splatwizard-core"), (("splatwizard-core",), "no lower or no upper"),
     (("splatwizard-core>=0.2",), "no upper bound"), (("splatwizard-core~=0.2", "numpy"), "no version of numpy")],
)  # fmt: skip
def test_requirements_without_versions(installed, requires, said):
    with pytest.raises(BrokenContractError, match=said):
        registration.check_requirements(installed("", requires))


@pytest.mark.parametrize(
    ("source", "said"),
    [("from splatwizard_core.runs.run import run", r"splatwizard_core.runs.run.run \(sw_bad.py\)"),
     ("def f():\n    import sw_codecs.testing", r"sw-codecs \(sw_bad.py\) without requiring"),
     ("import json\nimport rich", r"imports rich \(sw_bad.py\) without requiring it -> .*add 'rich' to dependencies"),
     ("from PIL import Image", "imports pillow .*add 'pillow'"),
     ("from splatwizard_core import api, runs", "splatwizard_core.runs")],
)  # fmt: skip
def test_imports_of_what_is_not_promised(installed, source, said):
    with pytest.raises(BrokenContractError, match=said):
        registration.check_imports(installed(source))


def test_what_only_a_type_checker_reads_may_come_from_anywhere(installed):
    source = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from splatwizard_core.runs.run import run\n"
    registration.check_imports(installed(source + "from splatwizard_core.api import Camera"))


def test_what_is_required_by_any_spelling_may_be_imported(installed):
    source = "import sw_bad, json, no_such_module\nimport numpy.random\nfrom PIL import Image\n"
    registration.check_imports(installed(source, ("splatwizard-core~=0.2", "numpy>=1", "Pillow>=1 ; extra == 'more'")))


def test_a_plugin_that_did_not_load():
    with pytest.raises(BrokenContractError, match="the plugin is broken: no such"):
        registration.check_loads(PluginInfo("bad", "sw-bad", "0.1", "sw_bad", error="no such module"))


def test_a_plugin_with_an_entry_that_is_refused(monkeypatch):
    entry = Entry("metric", "psnr", "m:f", "one line", distribution="sw-bad", version="0.1", foreign=True)
    monkeypatch.setattr(load_plugins().metrics, "refused", [(entry, "that is a name of ours")])
    registration.check_loads(PluginInfo("good", "sw-good", "0.1", "sw_good"))
    with pytest.raises(BrokenContractError, match="metric 'psnr' is refused: that is a name of ours"):
        registration.check_loads(PluginInfo("bad", "sw-bad", "0.1", "sw_bad"))


@pytest.mark.parametrize(
    ("entry", "said"),
    [(Entry("method", "a name", "m:C", "one line"), "nobody can type"),
     (Entry("method", "name", "m:C", ""), "summary"),
     (Entry("method", "name", "m:C", "two\nlines"), "summary"),
     (Entry("method", "name", "m:C", "TODO: one line"), "still has the summary 'TODO: one line'"),
     (Entry("method", "name", "m:C", "line", {"rates": "r1"}), "must be a list of names"),
     (Entry("method", "name", "m:C", "line", {"rate": ["r1"]}), "'rate', which its kind does not have"),
     (Entry("metric", "name", "m:C", "line"), "does not declare 'direction'"),
     (Entry("metric", "name", "m:C", "line", {"directoin": "higher"}), "'direction', but 'directoin', which"),
     (Entry("metric", "name", "m:C", "line", {"direction": "up"}), "direction='up'"),
     (Entry("metric", "name", "m:C", "line", {"direction": "lower", "over": "mesh"}), "over='mesh'"),
     (Entry("coder", "name", "m:C", "line", {"codes": "colours"}), "codes='colours'"),
     (Entry("exporter", "name", "m:C", "line", {"suffix": "ply"}), "suffix='ply'"),
     (Entry("command", "name", "m:C", "line", {"position": print}), "no plain value")],
)  # fmt: skip
def test_fields_that_are_not_legal(entry, said):
    with pytest.raises(BrokenContractError, match=said):
        check_entry(entry)


def test_an_unknown_feature_of_a_rasterizer():
    with pytest.raises(Exception, match="unknown features"):
        check_entry(Entry("rasterizer", "name", "m:C", "line", {"features": ["GLOSS"]}))


class NeedsAnArgument:
    uses_statistics = False

    def __init__(self, power):
        pass

    def score(self, model, cameras, rasterizer, background=None):
        pass


class NoBackground(NeedsAnArgument):
    def __init__(self):
        pass

    def score(self, model, cameras, rasterizer):
        pass


class Scores:
    uses_statistics = False

    def __init__(self, power=1.0):
        pass

    def score(self, model, cameras, rasterizer, background=None):
        pass


class WithoutDefault(Scores):
    class Settings(Params):
        power: float


class NotTaken(Scores):
    class Settings(Params):
        strength: float = 1.0


class OtherDefault(Scores):
    class Settings(Params):
        power: float = 2.0


class NoModel(Scores):
    Settings = 3


@pytest.mark.parametrize(
    ("target", "said"),
    [(WithoutDefault, "Settings is a pydantic model"), (NotTaken, "unexpected keyword argument 'strength'"),
     (OtherDefault, "'power' is 1.0 or 2.0 by default"), (NoModel, "cannot be made with its Settings")],
)  # fmt: skip
def test_settings_that_the_class_is_not_made_with(entry_of, target, said):
    assert "has the signatures" in check_target(entry_of("pruner", Scores), PLUGINS)
    with pytest.raises(BrokenContractError, match=said):
        check_target(entry_of("pruner", target), PLUGINS)


@pytest.mark.parametrize(
    ("kind", "target", "declared", "said"),
    [("pruner", NeedsAnArgument, {}, "cannot be made with its defaults"),
     ("pruner", NoBackground, {}, "cannot be called so"),
     ("pruner", object, {}, r"has no score\(\)"),
     ("metric", lambda render: 0.0, {}, "cannot be called with 2 arguments"),
     ("command", print, {}, "use @click.command"),
     ("dataset", NoBackground, {}, r"has no detect\(\)"),
     ("coder", NoBackground, {"codes": "arrays"}, r"has no encode\(\)")],
)  # fmt: skip
def test_targets_without_the_contracts_form(entry_of, kind, target, declared, said):
    with pytest.raises(BrokenContractError, match=said):
        check_target(entry_of(kind, target, **declared), PLUGINS)


class Pruner:
    uses_statistics = False

    def __init__(self):
        self.calls = 0

    def score(self, model, cameras, rasterizer, background=None):
        self.calls += 1
        return self.of(model, cameras)


class ChangesModel(Pruner):
    def of(self, model, cameras):
        model.means.data += 1
        return model.opacities.detach()


class ChangesGradients(Pruner):
    def of(self, model, cameras):
        model.means.sum().backward()
        return model.opacities.detach()


class Forgets(Pruner):
    def of(self, model, cameras):
        return model.opacities.detach() + self.calls


class ByFirstCamera(Pruner):
    def of(self, model, cameras):
        return (model.means.detach() - cameras[0].center).norm(dim=1)


class OneForAll(Pruner):
    def of(self, model, cameras):
        return model.opacities.mean()


@pytest.mark.parametrize(
    ("pruner", "said"),
    [(ChangesModel, "changes the model"), (ChangesGradients, "changes gradients"), (Forgets, "other scores"),
     (ByFirstCamera, "reverse order"), (OneForAll, "for 200 Gaussians")],
)  # fmt: skip
def test_pruners_that_do_more_than_score(entry_of, pruner, said):
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["pruner"](entry_of("pruner", pruner), PLUGINS)


class Fading(DensityControl):
    """Fades the Gaussians, the more the more often it was asked, and says so in its checkpoints."""

    asked = 0

    @property
    def rounds(self):
        return range(3_000, 24_000, 3_000)

    def adjust(self, state):
        self.asked += 1
        state.optimizer.replace(state.model, "opacity_logits", state.model.opacity_logits - 0.1 * self.asked)
        return {"faded": state.model.num_rows}

    def state_dict(self):
        return {"asked": self.asked}

    def load_state_dict(self, state):
        self.asked = state["asked"]


class FadingForgets(Fading):
    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        """It has nothing to restore."""


class FadingAsks(Fading):
    def needs(self, step):
        return frozenset({"grad2d", "gradients"})


class FadingLeaves(Fading):
    def begin(self, state):
        state.model.register_buffer("votes", torch.zeros(state.model.num_rows))
        state.model.ROWS = (*state.model.ROWS, "votes")


class FadingNeverAsked(Fading):
    rounds = None


def test_a_control_that_keeps_its_state_passes(entry_of):
    entry = entry_of("density control", Fading)
    assert "signatures of DensityControl" in check_target(entry, PLUGINS)
    assert "resumes bit-equal" in BEHAVIOUR["density control"](entry, PLUGINS)


@pytest.mark.parametrize(
    ("control", "said"),
    [(FadingForgets, "resumed ends as another model"), (FadingAsks, "needs names gradients"),
     (FadingLeaves, "still has votes"), (FadingNeverAsked, "rounds is None"), (dict, "no DensityControl")],
)  # fmt: skip
def test_controls_that_do_not_keep_their_contract(entry_of, control, said):
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["density control"](entry_of("density control", control), PLUGINS)


def in_place(render, truth):
    return float(render.sub_(truth).abs().mean())


@pytest.mark.parametrize(
    ("metric", "direction", "said"),
    [(lambda a, b: (a - b).abs().mean(), "lower", "returns a Tensor"), (in_place, "lower", "changes the images"),
     (lambda a, b: float((a - b).abs().mean()), "higher", "says the opposite"),
     (lambda a, b: float("nan"), "lower", "returns nan"),
     (lambda a, b: float(torch.rand(())), "lower", "a second call")],
)  # fmt: skip
def test_metrics_that_are_no_function_of_two_images(entry_of, metric, direction, said):
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["metric"](entry_of("metric", metric, direction=direction), PLUGINS)


def counted(subject):
    return MetricResult(float(subject.model.num_rows), [], "lower")


def moved(subject):
    subject.model.means.data += 1
    return counted(subject)


@pytest.mark.parametrize(
    ("metric", "said"),
    [(lambda subject: 1.0, "returns a float"), (moved, "changes the model"),
     (lambda subject: MetricResult(None, [], "lower"), "mean is None"),
     (lambda subject: MetricResult(float(torch.rand(())), [], "lower"), "a second call")],
)  # fmt: skip
def test_metrics_over_models_that_measure_no_model(entry_of, metric, said):
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["metric"](entry_of("metric", metric, direction="lower", over="model"), PLUGINS)
    assert "200" in BEHAVIOUR["metric"](entry_of("metric", counted, direction="lower", over="model"), PLUGINS)


@pytest.mark.parametrize(
    ("score", "said"),
    [(lambda path: 0.5, "that is no scene"), (lambda path: 2, "a number in 0..1"), (lambda path: None, "a number"),
     (lambda path: 0.9 if (path / "sparse").is_dir() else 0.0, "another family")],
)  # fmt: skip
def test_families_that_claim_what_is_not_theirs(entry_of, score, said):
    family = types.SimpleNamespace(detect=score, load=lambda path, options: None)
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["dataset"](entry_of("dataset", family), PLUGINS)


class Config(OptimizationParams):
    strength: float = 1.0


class BadMethod(Method):
    name = "bad-thing"
    Config = OptimizationParams

    def stages(self):
        return [Stage(self.config)]

    def create_model(self, scene, generator):
        return some_gaussians()

    def encode(self, model, writer):
        model.means.data += 1

    def decode(self, reader):
        return some_gaussians()


class BadTask(Stage):
    def register_post_task(self, scheduler, ppl, opt):
        scheduler.register_task(1, self.prune)

    def prune(self, model):
        pass


@pytest.mark.parametrize(
    ("changes", "declared", "said"),
    [({"name": "other"}, {}, "called 'other'"), ({}, {"rates": ["r1", "r2"]}, "rates are declared"),
     ({"PRESETS": {"paper": {}}}, {"presets": ["paper"]}, "no preset quick"),
     ({"DEFAULT_RATE": "r9"}, {}, "DEFAULT_RATE is 'r9'"), ({"Config": Config}, {}, "no description of strength"),
     ({"RATES": {"r1": {"no_such_key": 1}}}, {}, "no_such_key"),
     ({"stages": lambda self: []}, {}, "return one or more"),
     ({"stages": Method.stages}, {}, r"no stages\(\) -> def stages\(self\): return"),
     ({"decode": Method.decode}, {}, r"no decode\(\) -> def decode\(self, reader\): a model"),
     ({"create_model": Method.create_model}, {}, r"no create_model\(\), .* -> def create_model\(self, scene"),
     ({"stages": lambda self: [BadTask(self.config)]}, {}, "'model'")],
)  # fmt: skip
def test_declarations_of_a_method_that_do_not_fit_it(entry_of, changes, declared, said):
    entry = entry_of("method", type("Changed", (BadMethod,), changes), **declared)
    with pytest.raises(Exception, match=said):
        check_configuration(entry, PLUGINS)


def test_an_encoder_that_changes_its_model():
    with pytest.raises(BrokenContractError, match="encode changes the model"):
        _check_encoding(BadMethod(PLUGINS, None), some_gaussians())


@pytest.mark.parametrize(("sizes", "broken"), [((500, 400), True), ((400, 500), False), ((410, 400), False)])
def test_a_first_rate_point_with_the_largest_file(entry_of, monkeypatch, sizes, broken):
    bytes_of = dict(zip(("r1", "r2"), sizes, strict=True))
    monkeypatch.setattr(rate_points, "_size", lambda entry, plugins, settings, rate: bytes_of[rate])
    entry = entry_of("method", type("Two", (BadMethod,), {"RATES": {"r1": {}, "r2": {}}}))
    if broken:
        with pytest.raises(BrokenContractError, match="of r1 has 500 bytes, that of r2 400"):
            check_rate_points(entry, PLUGINS)
    else:
        assert check_rate_points(entry, PLUGINS).startswith(f"r1 {sizes[0]} bytes")
    assert "nothing to compare" in check_rate_points(entry_of("method", BadMethod), PLUGINS)


@pytest.mark.parametrize("folder", ["./sw-rows", "plugins/sw-rows", "sw-rows/"])
def test_a_folder_in_place_of_a_name(folder):
    with pytest.raises(UserInputError, match=r"is a folder: give the name .* \(as 'sw-rows'\)"):
        checks_of(folder)


def test_every_length_of_a_stage_is_found():
    class Block(Params):
        iterations: int = 1
        steps: int = 2

    class Nested(OptimizationParams):
        base_iterations: int = 3
        block: Block = Block()

    assert list(_lengths(Nested)) == ["iterations", "base_iterations", "block.iterations"]


def test_a_finding_tells_reason_and_cure_and_never_raises():
    def raising(error):
        def check():
            raise error

        return PackageCheck("sw-bad", "name", check).finding()

    broken = raising(BrokenContractError("why", "do this"))
    assert (broken.state, broken.detail, broken.mend) == ("broken", "why", "do this")
    # What says itself what to do has no second line; an error of Python's has the way to its traceback.
    assert raising(ConfigError("'k' is unknown: say 'key'")).mend is None
    assert raising(AssertionError("cut sections must be refused")).mend is None
    assert "--debug" in raising(AssertionError()).mend
    assert "--debug" in raising(KeyError("k")).mend
    assert raising(NotCheckedError("no GPU", "find one")).state == "missing"
    assert raising(SystemExit(3)).detail == "SystemExit: 3"
    assert PackageCheck("sw-bad", "name", lambda: "fine").finding().state == "ok"


FIGURES = """
[[tables]]
dataset = "mipnerf360"
protocol = "survey"
source = "a paper"
year = 2024
verified = false
figures = [{}]
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FIGURES.format('{ scene = "room", psnr = 30.0, rate = "r9" }'), "rate 'r9' is none of r1"),
        (FIGURES.format('{ scene = "room", psnr = 30.0, preset = "none" }'), "cannot be run with preset 'none'"),
        (FIGURES.format('{ psnr = 30.0, preset = "paper" }'), "cannot be run with preset 'paper'"),
        (FIGURES.format('{ scene = "room" }'), "neither psnr nor bytes"),
        (FIGURES.format('{ scene = "room", psnr = "high" }'), "table 1, figure 1: psnr"),
        ("", "holds no figure"),
    ],
)
def test_published_figures_that_are_wrong(text, said, tmp_path, monkeypatch):
    package = tmp_path / "sw_bad_figures"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "published.toml").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "sw_bad_figures", raising=False)
    ours = PLUGINS.methods.entry("3dgs")
    entry = Entry("method", "3dgs", ours.target, "one line", {"published": "sw_bad_figures:published.toml"}, "sw-bad")
    with pytest.raises(BrokenContractError, match=said):
        check_published(entry, PLUGINS)


def test_published_figures_that_are_right_are_counted(tmp_path, monkeypatch):
    assert check_published(PLUGINS.methods.entry("3dgs"), PLUGINS).endswith("of them second-hand")


def test_the_place_of_published_figures_is_a_file_of_a_package(entry_of):
    with pytest.raises(BrokenContractError, match="published"):
        check_entry(entry_of("method", Method, published="published.toml"))

"""docs/plugins.md as a reference: its examples make up a package, and every part of it keeps its contract."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import os
import re
import sys
from collections.abc import Iterator
from copy import copy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from PIL import Image
from plugin_page import BLOCKS, HOOKS, PACKAGE, files_of, run, write_package
from small_scene import context_of, small_scene, ten_gaussians, train_with
from sw_datasets.downloads.registry import parse_registry
from sw_doctor.registered import run_registered
from sw_kit.suite import checks_of
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.cli.main import cli
from splatwizard_core.coding.container import ContainerWriter
from splatwizard_core.errors import BitstreamError, CapabilityError, ConfigError, SceneError, UserInputError
from splatwizard_core.evaluation.evaluate import evaluate
from splatwizard_core.evaluation.metrics import MetricInfo, check_settings
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.method import create_method
from splatwizard_core.plugins import hookspecs
from splatwizard_core.plugins.check import Check
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions, ScoreSpec
from splatwizard_core.runs.decode import export_model, open_model
from splatwizard_core.runs.encode import encode
from splatwizard_core.runs.observers import FinishedRun, FinishedRuns, StartedTraining, watched_by
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.scene.scene import Scene
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import Scheduler, build_schedulers, format_plan
from sw_codecs import testing

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder on the path in which the package of the examples is installed."""
    folder = tmp_path_factory.mktemp("site")
    write_package(folder)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    yield folder
    sys.path.remove(str(folder))
    for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
        del sys.modules[name]


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Child processes find the package too."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), *filter(None, sys.path)]))


@pytest.fixture(scope="module")
def plugins(site: Path) -> PluginManager:
    """Everything that is installed, the package of the examples among it."""
    found = PluginManager(importlib.metadata.entry_points(group=hookspecs.ENTRY_POINT_GROUP))
    assert [(info.distribution, info.error) for info in found.plugins if info.key == "theirs"] == [("sw-theirs", None)]
    return found


@pytest.fixture(scope="module")
def alone(site: Path) -> PluginManager:
    """The package of the examples alone."""
    return PluginManager(importlib.metadata.entry_points(group=hookspecs.ENTRY_POINT_GROUP, name="theirs"))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return small_scene()


@pytest.fixture
def model(scene: Scene) -> GaussianModel:
    """Ten Gaussians, the first of them behind every camera."""
    return ten_gaussians(scene)


@pytest.mark.parametrize("hook", sorted(HOOKS))
def test_every_hook_has_an_example_that_is_used_here(hook):
    assert f"def {hook}(" in "".join(block for title, block in BLOCKS if title == hook)
    assert callable(globals().get(f"test_{hook}")), f"no test uses the example of {hook}"


def test_the_sections_that_are_no_hooks_have_an_example():
    assert {"Stages", "Codecs, pruners and their settings"} <= {title for title, _ in BLOCKS}


@pytest.mark.parametrize("number", range(len(BLOCKS)), ids=[f"{i}-{title[:24]}" for i, (title, _) in enumerate(BLOCKS)])
def test_every_block_runs(number, site):
    """Each part alone, so that none leans on what another one imports."""
    for name, text in files_of(BLOCKS[number][1]).items():
        if name in ("", "plugin"):
            run(text)
        else:
            importlib.import_module(f"{PACKAGE}.{name}")


def test_check_plugin_finds_nothing_wrong(plugins, installed, monkeypatch):
    monkeypatch.setattr("sw_kit.suite.load_plugins", lambda: plugins)
    entries = plugins.provided_by(next(info for info in plugins.plugins if info.key == "theirs"))
    assert {entry.kind for entry in entries} == {r.kind for r in plugins.registries.values()}
    checks = checks_of("sw-theirs", quick=True)
    assert len(checks) > len(entries)
    for check in checks:
        check()


def test_registering_imports_no_torch(site):
    for title, block in BLOCKS:
        if "plugin" in files_of(block):
            imported = re.findall(r"^(?:from|import) (\S+)", files_of(block)["plugin"], re.M)
            assert imported == ["splatwizard_core.api"], f"plugin.py of {title} imports {imported}"


def test_register_rasterizers(plugins, scene, model):
    rasterizer = NegotiatedRasterizer(plugins, device="cpu", prefer=["timed"])
    camera = scene.train[0].camera
    drawn = model.gaussians(camera, rasterizer)
    result = rasterizer.render(drawn, camera, RasterOptions())
    exact = ReferenceRasterizer().render(drawn, camera, RasterOptions())
    assert torch.equal(result.image, exact.image)
    assert torch.equal(rasterizer.visible_filter(drawn, camera), exact.radii)
    assert result.stats.stage_seconds["render"] > 0
    blend = RasterOptions(scores=(ScoreSpec("light", "blend"),))
    assert rasterizer.accumulate(drawn, [camera, camera], blend).scores["light"].shape == (10,)
    assert rasterizer.served == {"timed"}
    with pytest.raises(CapabilityError, match="does not offer ANTIALIAS"):
        plugins.rasterizers.load("timed")().render(drawn, camera, RasterOptions(antialias=True))


def test_register_pruners(plugins, scene, model):
    cls = plugins.pruners.load("light")
    pruner, cameras = cls(**cls.Settings().model_dump()), [view.camera for view in scene.train]
    before = model.digest()
    scores = pruner.score(model, cameras, ReferenceRasterizer(), torch.zeros(3))
    assert scores.shape == (10,)
    assert scores[0] == -torch.inf
    assert (scores[1:] > 0).all()
    assert torch.allclose(scores, pruner.score(model, cameras[::-1], ReferenceRasterizer()))
    assert torch.allclose(cls(power=2.0).score(model, cameras, ReferenceRasterizer())[1:], scores[1:] ** 2)
    assert model.digest() == before
    assert model.means.grad is None


def test_register_quantizers(plugins):
    steps = plugins.quantizers.load("steps")
    decoded, _, side = testing.check_quantizer(steps, torch.randn(20, 3), trained=steps(step=0.25))
    assert side == {"step": 0.25}
    assert torch.equal(decoded, (decoded * 4).round() / 4)


def test_register_entropy_models(plugins):
    weights = 0.5 ** np.arange(16)

    def case(n: int) -> testing.EntropyCase:
        symbols = np.random.default_rng(n).choice(16, size=n, p=weights / weights.sum())
        return testing.EntropyCase(symbols, n, n, n)

    testing.check_entropy_model(plugins.entropy_models.load("halving"), case)


def test_register_context_models(plugins):
    context = plugins.context_models.load("by-neighbour")(symbols=4)
    testing.check_context_model(context, torch.tensor([0, 3, 3]))
    context(torch.tensor([0, 3])).sum().backward()
    assert context.logits.grad.abs().sum(dim=1).tolist() == [4, 0, 0, 4]
    assert (context.counts() == 16385).all()


def test_register_coders(plugins, model):
    rng = np.random.default_rng(5)
    symbols = rng.choice(4, size=300, p=[0.6, 0.25, 0.1, 0.05])
    testing.check_entropy_coder(plugins.entropy_coders.load("deflated"), np.array([60, 25, 10, 5]), symbols)
    points = rng.integers(0, 1 << 6, size=(40, 3))
    points = np.concatenate([points, points[:3]])
    testing.check_position_codec(plugins.position_codecs.load("sorted-cells"), points, 6)
    for dtype in (np.float32, ">i2", np.bool_):
        testing.check_array_coder(plugins.array_coders.load("plain"), rng.integers(0, 2, size=(30, 2)).astype(dtype))
    vectors = rng.normal(size=(12, 5)).astype(np.float32)
    testing.check_vector_coder(plugins.vector_coders.load("two-floats"), plugins, vectors)
    decoded = testing.check_gaussian_codec(plugins.gaussian_codecs.load("theirs"), plugins, model)
    assert torch.equal(decoded.quats, model.quats.half().float())


def test_coders_refuse_what_they_did_not_write(plugins):
    order = plugins.position_codecs.load("sorted-cells")()
    data = order.encode(np.array([[0, 0, 0], [1, 1, 1]]), 4)
    with pytest.raises(BitstreamError, match="not in order"):
        order.decode(data[:8] + data[16:] + data[8:16])
    with pytest.raises(BitstreamError, match="not in order"):
        order.decode((1).to_bytes(8, "little") + b"\xff" * 8)
    bomb = plugins.entropy_coders.load("deflated")()
    with pytest.raises(BitstreamError, match="not 3 symbols"):
        bomb.decode(bomb.encode(np.zeros(1000, np.int64), 4), 3, 4)
    with pytest.raises(BitstreamError, match="not below 2"):
        bomb.decode(bomb.encode(np.full(3, 3), 4), 3, 2)


def test_register_tasks(plugins, scene, model):
    assert plugins.tasks.entry("prune-faint").declared["factory"] is False
    scheduler, context = Scheduler("post"), context_of(model, scene)
    scheduler.register_task(range(1, 3), plugins.tasks.load("prune-faint"))
    model.opacity_logits.data[4:6] = -8
    for step, left in ((1, "2 of 10"), (2, "0 of 8")):
        scheduler.exec(step, context)
        assert context.log.said[-1] == ("prune", f"{left} Gaussians go")
    assert model.num_rows == 8
    assert context.log.scalars["pruned"] == 0


def test_register_density_controls(plugins, scene, tmp_path):
    sets = {"density": "crowding", "density.settings.start": 1, "density.settings.interval": 2}
    method = create_method(plugins, "3dgs", {**sets, "iterations": 6})
    assert method.config.density.settings == {"start": 1, "stop": 15_000, "interval": 2, "share": 0.05}
    assert "adjust density" in format_plan(*build_schedulers(method.stages()[0], PipelineParams()))
    start = method.create_model(scene, torch.Generator()).num_rows
    trained = train_with(method.stages(), lambda: method.create_model(scene, torch.Generator()), scene)
    assert trained.num_rows == start + 3 * int(0.05 * start)
    with pytest.raises(ConfigError, match=r"did you mean .density\.settings\.share"):
        create_method(plugins, "3dgs", {"density": "crowding", "density.settings.shre": 1})


def test_register_methods(plugins, scene, tmp_path):
    method = create_method(plugins, "their-method", {"iterations": 2})
    declared = plugins.methods.entry("their-method").declared
    assert [*method.PRESETS] == declared["presets"]
    assert [*method.RATES] == declared["rates"]
    trained = train_with(method.stages(), lambda: method.create_model(scene, torch.Generator()), scene)
    trained.requires_grad_(False)
    path = tmp_path / "scene.swz"
    facts = encode(method, trained, {}, path)
    assert ("coder", "gaussians-exact") in [(part.kind, part.name) for part in facts.parts]
    decoded, reader = open_model(path, plugins, CPU)
    assert reader.method == "their-method"
    assert torch.equal(decoded.sh_dc, trained.sh_dc)
    older = ContainerWriter("their-method", 0)
    older.write(path)
    with pytest.raises(BitstreamError, match="layout version 0 is unknown"):
        open_model(path, plugins, CPU)
    nothing = dataclasses.replace(scene, points=None)
    with pytest.raises(SceneError, match="no start points"):
        method.create_model(nothing, torch.Generator())


def test_a_stage(site, scene, model):
    from sw_theirs.stage import TheirConfig, TheirStage

    stage = TheirStage(TheirConfig(iterations=2, faint=0.5))
    assert build_schedulers(stage, PipelineParams())[1].plan_lines()
    assert stage.when(range(500, 15_000, 100)) == range(500, 15_000, 100)
    shorter = TheirStage(TheirConfig(iterations=300, scale_schedule=True))
    assert shorter.when(range(500, 15_000, 100)) == range(5, 150, 1)
    seen = []
    before = model.means.detach().clone()
    trained = train_with([stage], lambda: model, scene, lambda _, state: seen.append(copy(state)))
    assert [record.step for record in seen] == [1, 2]
    assert seen[0].parts.keys() == {"l1", "ssim", "opacity"}
    expected = 0.8 * seen[0].parts["l1"] + 0.2 * (1 - seen[0].parts["ssim"]) + 0.5 * seen[0].parts["opacity"]
    assert torch.isclose(seen[0].total, expected)
    assert torch.equal(trained.means, before)  # in no group

    class Untrained(TheirStage):
        iterations = 0

    assert train_with([Untrained(TheirConfig())], lambda: model, scene) is model


def test_register_datasets(plugins, tmp_path):
    folder = tmp_path / "my-ring"
    folder.mkdir()
    family = plugins.datasets.load("ring")()
    assert family.detect(folder) == family.detect(tmp_path / "not-there") == 0
    (folder / "ring.json").write_text('{"radius": 3, "fov": 0.8}')
    for i in range(9):
        Image.new("RGB", (8, 6), (i, 0, 255)).save(folder / f"{i}.png")
    scene = load_scene(str(folder), SceneOptions(), plugins)
    assert (scene.protocol.dataset, len(scene.train), len(scene.test)) == ("ring", 7, 2)
    assert torch.allclose(scene.train[0].camera.center.norm(), torch.tensor(3.0))
    assert scene.test[1].pixels[:, 0, 0].tolist() == [8, 0, 255]
    (folder / "ring.json").write_text('{"radius": 3}')
    with pytest.raises(SceneError, match=r"ring\.json: KeyError"):
        load_scene(f"ring:{folder}", SceneOptions(), plugins)


def test_register_downloads(plugins):
    (listed,) = parse_registry(plugins.downloads.load("theirs")(), "theirs")
    assert (listed.id, listed.scenes, listed.files[0].name) == ("atrium", ("stairs", "fountain"), "atrium.tar.gz")


def test_register_metrics(plugins, scene, model):
    settings = check_settings(plugins.metrics, {"weighted": {"green": "0.75"}})
    result = evaluate(
        model, scene.test, ReferenceRasterizer(), plugins,
        device=CPU, options=RasterOptions(), metrics=["edge-error", "weighted"], metric_settings=settings,
    )  # fmt: skip
    edges, weighted = result.metrics["edge-error"], result.metrics["weighted"]
    assert 0 < edges.mean < 2
    assert 0 < weighted.mean < 1
    assert (dict(weighted.made_with), weighted.verified, edges.verified) == ({"green": "0.75"}, False, True)
    info = MetricInfo.of(plugins.metrics.entry("edge-error"))
    assert (info.label, info.direction, info.digits) == ("Edge error", "lower", 4)
    image = scene.test[0].image()
    assert plugins.metrics.load("edge-error")(image, image) == 0
    with pytest.raises(ConfigError, match=r"did you mean 'metrics\.weighted\.green'"):
        check_settings(plugins.metrics, {"weighted": {"gren": 1}})


def test_register_exporters(plugins, model, tmp_path):
    path = tmp_path / "scene.points"
    before = model.digest()
    assert export_model(model, path, plugins) == "points"
    assert model.digest() == before
    rows = np.loadtxt(path)
    assert np.allclose(rows[:, 3], model.opacities.detach().numpy(), atol=1e-6)  # six digits
    with pytest.raises(UserInputError, match="no explicit Gaussians"):
        export_model(SplatModel(), path, plugins)


@pytest.mark.filterwarnings("ignore:loadtxt")
def test_register_importers(plugins, model, tmp_path):
    path = tmp_path / "scene.points"
    export_model(model, path, plugins)
    found = plugins.importers.load("points")(path)
    assert torch.allclose(found.means, model.means, atol=1e-4)  # six digits
    assert torch.allclose(found.opacities, model.opacities, atol=1e-5)
    for damaged in ("1 2 3\n", "1 2 x 4\n", "", "nan 0 0 1\n"):
        path.write_text(damaged)
        with pytest.raises(UserInputError, match="cannot be read"):
            plugins.importers.load("points")(path)


def test_register_checks(plugins, installed):
    found = [Check("radio", "aerial", "missing", "none is plugged in", "buy one")]
    assert plugins.checks.load("radio")() == found
    assert run_registered(plugins.checks.entry("radio")) == found


def test_register_executors(plugins, tmp_path):
    cls = plugins.executors.load("one-by-one")
    executor = cls(cls.Options(), SimpleNamespace(out=tmp_path, device="cpu"))
    for number in (0, 3):
        program = f"import sys; print('number', {number}); sys.exit({number})"
        executor.start(str(number), [sys.executable, "-c", program], tmp_path / "log")
    assert sorted(executor.ended(1.0)) == [("0", 0, "here"), ("3", 3, "here")]
    assert (tmp_path / "log").read_text() == "number 3\nnumber 0\n"
    executor.stop()
    assert executor.ended(0.0) == []


def test_register_commands(plugins, tmp_path, monkeypatch):
    path = tmp_path / "scene.swz"
    writer = ContainerWriter("their-method", 1)
    writer.add("means", b"12345")
    writer.write(path)
    monkeypatch.setattr("splatwizard_core.cli.main.load_plugins", lambda: plugins)
    result = CliRunner().invoke(cli, ["sections", str(path)], catch_exceptions=False)
    assert result.output.split() == ["means", "5"]
    told = CliRunner().invoke(cli, ["sections", str(path), "--json"], catch_exceptions=False)
    assert '"means": 5' in told.output
    assert "bytes of a file by section" in CliRunner().invoke(cli, ["--help"]).output


def test_describe_scene(plugins, scene):
    facts = plugins.hook.describe_scene(scene=scene)
    assert {"views_with_a_mask": 0} in facts


def test_run_started(alone, scene, model, tmp_path):
    from sw_theirs.stage import TheirConfig, TheirStage

    started = StartedTraining("their-method", tmp_path, scene, ReferenceRasterizer())
    observers = alone.hook.run_started(training=started)
    with watched_by(observers, alone, pytest.fail) as after_step:
        train_with([TheirStage(TheirConfig(iterations=2))], lambda: model, scene, after_step)
    assert (tmp_path / "gaussians.csv").read_text() == "stage,step,gaussians\ntheirs,1,10"


def test_run_finished(alone, scene, tmp_path):
    record = SimpleNamespace(method="their-method", file=SimpleNamespace(bytes=123))
    finished = [FinishedRun(tmp_path, record, lambda: scene)]
    written: list[Path] = []
    for complete in (False, True):
        alone.hook.run_finished(runs=FinishedRuns(finished, complete, None, pytest.fail, written))
    assert written == [tmp_path / "bytes.txt"]
    assert written[0].read_text() == "their-method 123\n"


def test_settings_of_providers_and_of_methods(plugins):
    provider, method = (block for title, block in BLOCKS if title == "Codecs, pruners and their settings")
    namespace = run(provider)
    pruner = namespace["TheirPruner"](**namespace["TheirSettings"]().model_dump())
    assert pruner.power == 0.5
    namespace = run(method)
    config = namespace["TheirConfig"](prune={"pruner": "light", "settings": {"power": 2}}).completed(plugins, {})
    assert config.prune.load(plugins).power == 2
    assert type(config.codec.load(plugins)) is plugins.gaussian_codecs.load("gaussians-quantized")
    assert namespace["TheirCodec"]().settings.bits == 8

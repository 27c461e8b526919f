"""What a run measures beside quality: speed with its spread, loading, LPIPS once its weights are there."""

import importlib.util
import sys
from types import SimpleNamespace

import pytest
import torch
from lpips_backbones import write_backbones
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.plugins import Entry, PluginManager
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_core.runs.config import parse_set, resolve
from splatwizard_core.runs.directory import RunRequest
from splatwizard_core.runs.facts import Extent
from splatwizard_core.runs.measure import Opened, measure
from splatwizard_core.runs.record import Record, missing_reasons
from splatwizard_core.runs.run import run
from splatwizard_core.runs.session import Session

pytestmark = pytest.mark.pipeline

LPIPS = ("lpips_vgg_3dgs", "lpips_vgg", "lpips_alex")


@pytest.fixture(scope="module")
def runs(toy_plugins: PluginManager, tmp_path_factory: pytest.TempPathFactory):
    """One run, given three times: plain, with weights and repeats, plain again."""
    if importlib.util.find_spec("lpips") is None:
        pytest.skip("LPIPS is the extra sw-metrics[lpips]")
    root = tmp_path_factory.mktemp("measured")
    weights = write_backbones(tmp_path_factory.mktemp("weights"), "alex")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_HOME", str(tmp_path_factory.mktemp("torch-home")))
        patch.delenv("SPLATWIZARD_DATA", raising=False)

        def once(*sets: str, **options: object) -> tuple[Record, list[str]]:
            said: list[str] = []
            session = Session(toy_plugins, torch.device("cpu"), said.append)
            method = toy_plugins.methods.load("toy")
            resolved = resolve(method, rate="r1", sets=parse_set(["eval_every=3", *sets]), scene="demo:tiny")
            return run(session, RunRequest(resolved, root, **options))[0], said

        yield SimpleNamespace(plain=once(), asked=once(f"metrics.lpips.weights={weights}", repeats=4), again=once())


def test_without_weights_lpips_is_null_with_its_reason(runs):
    record, _ = runs.plain
    for name in LPIPS:
        assert (record.metrics[name].mean, record.metrics[name].per_view) == (None, [])
        assert record.unknown[f"metrics.{name}.mean"].startswith("weights-missing")
    assert "unverified-weights" not in record.flags
    assert missing_reasons(record) == []


def test_weights_that_are_brought_fill_the_record_without_training_again(runs):
    record, said = runs.asked
    assert not any(line.startswith(("training", "encoded")) for line in said)
    alex = record.metrics["lpips_alex"]
    assert alex.mean == pytest.approx(sum(alex.per_view) / 2)
    assert 0 < alex.mean < 2
    assert alex.made_with["weights"] == "alexnet-owt-7be5be79.pth"
    assert "unverified-weights" in record.flags  # made for this test, not the published ones
    assert record.metrics["lpips_vgg"].mean is None  # only the other net's were brought
    for name in ("psnr", "ssim", "l1"):
        assert record.metrics[name] == runs.plain[0].metrics[name]
    assert record.train == runs.plain[0].train


def test_repeats_leave_their_spread_in_the_record(runs):
    (plain, _), (asked, _) = runs.plain, runs.asked
    assert (plain.speed.repeats, plain.speed.spread) == (1, None)
    assert "--repeats" in plain.unknown["speed.spread"]
    assert asked.speed.repeats == asked.speed.spread["fps"].n == 4
    assert asked.speed.frames == 4 * asked.speed.rounds * asked.speed.views
    fps = asked.speed.spread["fps"]
    assert fps.min <= fps.mean <= fps.max
    assert fps.min <= asked.speed.fps <= fps.max
    # More than the three of the first decode: it was done again too.
    assert asked.codec.decode_spread.n == len(asked.codec.decode_runs_s) == 4


def test_what_was_measured_is_not_lost_to_a_command_that_asks_for_less(runs):
    record, said = runs.again
    assert record == runs.asked[0]
    assert any("is finished" in line for line in said)


def test_loading_and_compiling_are_told_apart(runs):
    record, _ = runs.asked
    assert record.speed.load_s > record.speed.prepare_s >= 0
    assert record.speed.jit_s >= 0
    assert record.codec.jit_s >= 0
    assert record.memory.peak_load_bytes >= 0
    assert record.train.pictures_in == "host"


@pytest.mark.parametrize(("kernels", "others"), [("", True), ("reference", False)])
def test_a_file_that_prefers_other_kernels_is_timed_with_the_default_ones_too(
    toy_plugins: PluginManager, monkeypatch, kernels, others
):
    declared = {"devices": ["cpu"], "dtypes": ["float32"], "exactness": "approx-uint8", "kernels": kernels}
    features = [*toy_plugins.rasterizers.entry("reference").declared["features"]]
    entry = Entry("rasterizer", "own", "own_rasterizer:Own", "a fake", {**declared, "features": features}, "a", "1")
    own = type("Own", (ReferenceRasterizer,), {"info": RasterizerInfo.from_entry(entry)})
    monkeypatch.setitem(sys.modules, "own_rasterizer", SimpleNamespace(Own=own))
    monkeypatch.setitem(toy_plugins.rasterizers._entries, "own", entry)
    session = Session(toy_plugins, torch.device("cpu"), lambda line: None)
    resolved = resolve(toy_plugins.methods.load("toy"), rate="r1", scene="demo:tiny")
    model = toy_plugins.methods.load("toy")(toy_plugins, resolved.config).create_model(session.scene(resolved), None)

    def open_model() -> Opened:
        return Opened(model.eval().requires_grad_(False), {"prefer": ["own"]})

    speed = measure(session, resolved, open_model, metrics=["psnr"]).speed
    assert speed.drawn_by == {"own": kernels or "own"}
    assert list(speed.default_fps) == (["reference"] if others else [])


def test_only_quick_metrics_are_computed_on_the_way(runs, tmp_path_factory):
    import json

    log = next(tmp_path_factory.getbasetemp().glob("measured*/demo-tiny/toy/r1/log.jsonl"))
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    evaluated = [line["metrics"] for line in lines if "metrics" in line]
    assert len(evaluated) == 2
    assert set(evaluated[0]) == {"psnr", "ssim", "l1", "toy-error"}


def test_an_earlier_measurement_counts_if_it_holds_all_that_is_asked():
    asked = Extent(repeats=2, metrics={"psnr": "core 1", "lpips_vgg": None})
    held = Extent(repeats=3, metrics={"psnr": "core 1", "lpips_vgg": "weights a"}, eval_train=True)
    assert held.holds(asked)
    assert asked.holds(asked)
    assert not asked.holds(asked.model_copy(update={"eval_train": True}))
    undrawn = Extent.model_validate({"repeats": 3, "metrics": held.metrics})  # of a release that drew no training views
    assert not undrawn.holds(held)
    for change, wanted in (({"repeats": 1}, {}), ({"metrics": {"psnr": "core 0"}}, {}),
                           ({}, {"metrics": {"lpips_vgg": "weights b"}})):  # fmt: skip
        assert not held.model_copy(update=change).holds(asked.model_copy(update=wanted))


def test_the_record_names_no_folder_of_this_machine(runs):
    made_with = runs.asked[0].metrics["lpips_alex"].made_with
    assert not any("/" in value for value in made_with.values())
    assert not any("torch-home" in reason or "/tmp" in reason for reason in runs.asked[0].unknown.values())

"""pruned-3dgs: its plan, the counts that it leaves, and that any pruner decides."""

import json

import pytest
from safetensors.torch import load_file

from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers
from sw_3dgs.pruned import Pruned3DGS


def plan_of(**values) -> dict[str, str]:
    config = resolve(Pruned3DGS, "paper", sets={k.replace("__", "."): v for k, v in values.items()}).config
    (stage,) = Pruned3DGS(load_plugins(), config).stages()
    pre, post = build_schedulers(stage, PipelineParams())
    return {each.name: str(each.when) for each in (*pre.registrations, *post.registrations)}


def test_the_plan_is_six_rounds_700_steps_apart():
    assert plan_of() == {"update lr": "range(0, 30000)", "prune by removal": "[100, 800, 1500, 2200, 2900, 3600]"}
    assert plan_of(prune__rounds=2, prune__interval=50)["prune by removal"] == "[100, 150]"


def test_learning_rates_fall_by_ten():
    rates = resolve(Pruned3DGS, "paper").config.lr
    first, last = rates.of_step(0, 2.0), rates.of_step(9_999, 2.0)
    assert first["means"] == pytest.approx(3.2e-5)
    assert all(last[name] == pytest.approx(first[name] / 10, rel=0.1) for name in first)


def test_a_pruner_of_gradient_statistics_has_them_collected_before_each_round():
    plan = plan_of(prune__pruner="trimming-the-fat")
    assert plan["clear gradient statistics"] == "[1, 701, 1401, 2101, 2801, 3501]"
    assert "prune by trimming-the-fat" in plan


@pytest.mark.pipeline
@pytest.mark.parametrize("asked", ["count", "share"])
def test_a_run_leaves_as_many_gaussians_as_asked_for(tmp_path, asked):
    # Six views of 64 x 48 pixels; the 3DGS scene that it starts from is trained first.
    left = ["prune.count=123"] if asked == "count" else ["prune.rounds=1", "prune.keep=0.5"]
    sets = [f"--set={x}" for x in ("iterations=30", "scale_schedule=true", "pretrained.iterations=30", *left)]
    assert main(["run", "--method", "pruned-3dgs", "--scene", "demo:tiny", "--out", str(tmp_path), *sets]) == 0
    (path,) = tmp_path.glob("demo-tiny/pruned-3dgs/r3/metrics.json")
    (trained,) = tmp_path.glob(".trained/*/checkpoints/*.safetensors")
    before = len(load_file(trained)["model/means"])
    assert json.loads(path.read_text())["counts"]["num_gaussians"] == (
        123 if asked == "count" else before - before // 2
    )

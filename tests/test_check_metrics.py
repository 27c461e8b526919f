"""The metrics of a finished run equal those of scikit-image and torchmetrics: benchmarks/check_metrics.py."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "check_metrics.py"

for package in ("skimage", "torchmetrics"):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is the other implementation", allow_module_level=True)

pytestmark = pytest.mark.pipeline


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("check_metrics", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["check_metrics"] = module  # its dataclass looks itself up there
    spec.loader.exec_module(module)
    yield module
    del sys.modules["check_metrics"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run directory of a few steps on the small demo scene, written to disk as a data set first."""
    root = tmp_path_factory.mktemp("checked")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        assert main(["data", "synth", str(root / "scene"), "--size", "tiny"]) == 0
        assert main(
            ["run", "--scene", str(root / "scene"), "--rate", "r6", "--preset", "quick", "--set", "iterations=30",
             "--set", "test_every=4", "--device", "cpu", "--out", str(root / "out")]
        ) == 0  # fmt: skip
    return root / "out" / "scene" / "3dgs" / "r6"


def run_script(script, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["check_metrics.py", *arguments])
    return script.main()


def test_a_run_agrees_in_every_metric_and_convention(script, finished: Path, monkeypatch, capsys):
    assert run_script(script, monkeypatch, str(finished)) == 0
    rows = list(script.check(finished, None))
    assert {row.metric for row in rows} == {"psnr", "psnr_channel_mean", "ssim", "ssim_valid", "ssim_reflect", "l1"}
    assert all(row.agrees for row in rows)
    assert "DIFFERS" not in capsys.readouterr().out
    means = {row.metric: row.recorded for row in rows}
    # The conventions are far enough apart on a picture this small for the check to tell them.
    assert len({round(means[name], 3) for name in ("ssim", "ssim_valid", "ssim_reflect")}) == 3


@pytest.mark.parametrize(("metric", "error"), [("psnr", 2e-3), ("ssim", 2e-4), ("ssim_reflect", -2e-4), ("l1", 2e-4)])
def test_a_wrong_record_is_found(script, finished: Path, tmp_path: Path, monkeypatch, capsys, metric, error):
    copy = tmp_path / "run"
    shutil.copytree(finished, copy, ignore=shutil.ignore_patterns("checkpoints"))
    record = json.loads((copy / "metrics.json").read_text())
    record["metrics"][metric]["per_view"][1] += error
    (copy / "metrics.json").write_text(json.dumps(record))
    assert run_script(script, monkeypatch, str(copy)) == 1
    told = [line for line in capsys.readouterr().out.splitlines() if "DIFFERS" in line]
    assert len(told) == 1
    assert metric in told[0]


@pytest.mark.parametrize("layout", ["colmap", "blender"])
def test_it_reads_the_ground_truth_that_our_loaders_read(script, tmp_path: Path, layout: str):
    assert main(["data", "synth", str(tmp_path / "s"), "--size", "tiny", "--format", layout]) == 0
    scene = load_scene(str(tmp_path / "s"), SceneOptions(resolution=40), load_plugins())
    assert scene.test
    record = {"protocol": {"images": scene.protocol.images, "background": scene.protocol.background}}
    for view in scene.test:
        theirs = script.ground_truth(tmp_path / "s", record, view.name, (view.camera.width, view.camera.height))
        ours = view.image(scene.background).permute(1, 2, 0).double()
        assert torch.allclose(torch.from_numpy(theirs), ours, atol=1e-6), view.name  # float32 compositing

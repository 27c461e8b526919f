"""benchmarks/geometry_demo.py: order, what travels, what is done again, and the ratios; `sw` itself is replaced."""

from __future__ import annotations

import importlib.util
import io
import itertools
import json
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import pytest
import torch
from rich.console import Console
from sw_gaussians.surfels import Surface, SurfelModel

from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.decode import open_model
from splatwizard_core.runs.encode import encode

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "geometry_demo.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("geometry_demo", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "geometry_demo", module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def start(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Run the command; returns the first word and the method or file of each `sw` that it gave."""
    monkeypatch.setattr(script, "of_degree_0", lambda file, plugins: file.read_bytes())

    def started(*arguments: str, fails: str = "nothing", status: int = 0) -> list[tuple[str, str]]:
        given: list[tuple[str, str]] = []

        def sw(command, *words, threads):
            words = [str(word) for word in words]
            said = dict(itertools.pairwise(words))
            given.append((command, said["--method"] if command == "run" else "/".join(Path(words[0]).parts[-4:-1])))
            if fails in words:
                raise script.CommandError("sw run: it failed")
            if command == "mesh":
                return {"chamfer": {"overall": 0.01, "f1": 0.9, "acc": 0.01, "comp": 0.01}}
            for rate in said["--rate"].split(","):
                run = Path(said["--out"]) / "demo" / said["--method"] / rate
                run.mkdir(parents=True)
                (run / "scene.swz").write_bytes(b"a file")
                record = {"metrics": {"psnr": {"mean": 30.0}}, "counts": {"num_gaussians": 5}}
                (run / "metrics.json").write_text(json.dumps(record))
            return {}

        monkeypatch.setattr(script, "sw", sw)
        monkeypatch.setattr(sys, "argv", ["geometry_demo.py", str(tmp_path / "out"), "--device", "cpu", *arguments])
        assert script.main() == status
        return given

    return started


def test_a_method_waits_for_the_one_that_it_starts_from(start, tmp_path):
    given = start("--methods", "trim-2dgs@r6,hac@r3,2dgs@r3+r6", "--seeds", "0", "--train-only")
    assert given == [("run", "hac"), ("run", "2dgs"), ("run", "trim-2dgs")]
    with zipfile.ZipFile(tmp_path / "out" / "seed-0.zip") as archive:
        assert {name.rpartition("/")[0] for name in archive.namelist()} == {
            "hac/r3", "2dgs/r3", "2dgs/r6", "trim-2dgs/r6",
        }  # fmt: skip


def test_what_was_trained_or_meshed_is_not_done_again(start):
    words = ["--methods", "2dgs@r6", "--seeds", "0,1"]
    assert start(*words) == [
        ("run", "2dgs"), ("run", "2dgs"), ("mesh", "seed-0/2dgs/r6"), ("mesh", "seed-1/2dgs/r6"),
    ]  # fmt: skip
    assert start(*words) == []
    assert [command for command, _ in start("--mesh-only", "--voxel-size", "0.04")] == ["mesh", "mesh"]


def test_one_failure_leaves_the_rest_and_is_told(start, capsys):
    given = start("--methods", "2dgs@r6,hac@r3", "--seeds", "0", fails="2dgs", status=1)
    assert given[-1] == ("mesh", "seed-0/hac/r3")
    assert "2dgs of seed 0: sw run: it failed" in capsys.readouterr().err


def test_ratios_pair_each_seed_with_itself(script):
    def facts(size, psnr, chamfer):
        return {"bytes": size, "psnr": psnr, "chamfer": chamfer, "f1": 0.9}

    found = {
        "seed-0/2dgs/r3": facts(10, 29.0, 0.011), "seed-0/2dgs/r6": facts(100, 30.0, 0.010),
        "seed-1/2dgs/r3": facts(10, 33.0, 0.036), "seed-1/2dgs/r6": facts(100, 34.0, 0.040),
        "seed-2/2dgs/r3": facts(10, 35.0, 0.036),
    }  # fmt: skip
    whole, ratios = script.tables(found, {"2dgs": ("r3", "r6")})
    out = io.StringIO()
    Console(file=out, width=120).print(whole, ratios)
    assert "32.00 ± 2.83" in out.getvalue()  # r6 of seeds 0 and 1
    assert "1.000 ± 0.141" in out.getvalue()  # 1.1 and 0.9; seed 2 has no whole file
    assert "10.0 ± 0.0" in out.getvalue()


def test_a_float32_file_travels_without_the_colours_that_no_mesh_shows(script, tmp_path):
    plugins, generator = load_plugins(), torch.Generator().manual_seed(0)

    def some(*shape):
        return torch.randn(*shape, generator=generator)

    model = SurfelModel(some(50, 3), some(50, 1, 3), some(50, 15, 3), some(50), some(50, 2), some(50, 4))
    model.surface = Surface(1.0, 100.0, 0.05)
    cls = plugins.methods.load("2dgs")
    for codec, smaller in (("gaussians-exact", True), ("gaussians-quantized", False)):
        config = resolve(cls, "paper", sets={"codec.name": codec}, plugins=plugins).config
        file = tmp_path / f"{codec}.swz"
        encode(cls(plugins, config), model, {}, file)
        found = script.of_degree_0(file, plugins)
        assert (found != file.read_bytes()) is smaller
        if smaller:
            assert len(found) < file.stat().st_size / 2
            file.write_bytes(found)
            again, _ = open_model(file, plugins, torch.device("cpu"))
            assert again.sh_rest.shape[1] == 0
            assert torch.equal(again.means, model.means)
            assert again.surface == model.surface

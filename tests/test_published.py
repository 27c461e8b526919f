"""benchmarks/published.py, anchor_starts.py: cells are run once, by one `sw bench`, and stand beside what is known."""

from __future__ import annotations

import importlib
import json
import shutil
import sqlite3
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
from sw_bench.cells import Layout, cells_of
from sw_bench.plan import read_plan

from splatwizard_core.plugins import load_plugins

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
RECORD = {
    "schema_version": 3, "method": "3dgs", "rate": "r6", "preset": "paper", "dataset": "demo", "scene": "demo-tiny",
    "metrics": {"psnr": {"mean": 31.5}, "ssim": {"mean": 0.9}}, "file": {"bytes": 1234}, "test_views": 2,
    "counts": {"num_gaussians": 50}, "train": {"steps": 5}, "protocol": {"id": "demo/64x48", "background": "white"},
}  # fmt: skip
NOTHING = {"plan": False, "table": False, "jobs": 0, "gpus": "", "device": "", "deadline": None, "bench": []}


def module(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for each in ("sweep_cells", "published", "anchor_starts", "removal_table", "wisp_ladder"):
        monkeypatch.delitem(sys.modules, each, raising=False)
    return importlib.import_module(name)


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return module("published", monkeypatch)


@pytest.fixture
def starts(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return module("anchor_starts", monkeypatch)


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """$SPLATWIZARD_DATA with a folder for chair of NeRF Synthetic, which nothing reads."""
    (tmp_path / "data" / "nerf_synthetic" / "chair").mkdir(parents=True)
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


class FakeBench:
    """`sw bench` without trainings: writes the record of every run of its plan that has none, or lets some fail.

    psnr    (method, rate, seed) -> dB; bytes: rate -> bytes
    fails   labels that fail
    """

    def __init__(self, sizes: dict[str, int], fails: tuple[str, ...] = ()) -> None:
        self.sizes, self.fails = sizes, fails
        self.commands: list[list[str]] = []
        self.environments: list[dict[str, str]] = []
        self.made: list[Path] = []

    def __call__(self, command: list[str], env: dict[str, str]) -> FakeBench:
        self.commands.append(command[3:])
        self.environments.append(env)
        plan, _ = read_plan(command[command.index("bench") + 1])
        out = Path(command[command.index("--out") + 1])
        index = sqlite3.connect(out / "bench.sqlite")
        index.execute("CREATE TABLE IF NOT EXISTS runs (label, scene, seed, rate, status, reason)")
        for seed in plan.seeds:
            for label in plan.methods:
                for scene in plan.scenes:
                    values = plan.values_for(label, scene, seed)
                    for rate in (values.rates or "").split(",") if values else ():
                        if label in self.fails:
                            row = (label, scene, seed, rate, "failed", "CUDA out of memory")
                            index.execute("INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?)", row)
                            continue
                        self.record(out, plan.method_of(label), label, scene, seed, rate, str(values.preset))
        index.commit()
        index.close()
        return self

    def record(self, out: Path, method: str, label: str, scene: str, seed: int, rate: str, preset: str) -> None:
        root = f"seed-{seed}" + (f"-{label}" if label != method else "")
        name = scene.rpartition("/")[2].replace(":", "-")
        folder = out / root / name / method / rate
        if (folder / "metrics.json").exists():
            return
        folder.mkdir(parents=True)
        number = int(rate[1:])
        content = {
            **RECORD, "method": method, "rate": rate, "preset": preset, "scene": name, "dataset": "nerf_synthetic",
            "metrics": {"psnr": {"mean": 33.5 + 0.5 * number + 0.05 * seed}}, "file": {"bytes": self.sizes[rate]},
            "config": {"pipeline": {"seed": seed}},
        }  # fmt: skip
        (folder / "metrics.json").write_text(json.dumps(content))
        self.made.append(folder)

    def wait(self, timeout: float | None = None) -> int:
        return int(bool(self.fails))


SIZES = {f"r{i}": 400_000 * 2**i for i in range(1, 8)}


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch):
    """bench(script, *arguments): run a command on a fake `sw bench`; its exit status and that bench."""

    def run(script: ModuleType, *arguments: object, fails: tuple[str, ...] = ()) -> tuple[int, FakeBench]:
        fake = FakeBench(SIZES, fails)
        cells = sys.modules["sweep_cells"]
        monkeypatch.setattr(cells.subprocess, "Popen", fake)
        monkeypatch.setattr(sys, "argv", ["script.py", *map(str, arguments)])
        return script.main(), fake

    return run


def test_chair_is_run_as_published_with_three_seeds_of_the_hac_family(script):
    rows = script.rows_of(script.read_published())
    cells = script.cells_of(rows, script.SEEDS, script.CURVES.split(","), ["c3dgs@r4"])
    chair = [cell for cell in cells if cell.scene == "nerf_synthetic/chair"]
    of = {label: {(c.rate, c.seed) for c in chair if c.label == label} for label in {c.label for c in chair}}
    ends, curve = {(rate, seed) for rate in ("r1", "r5") for seed in range(3)}, {(f"r{i}", 0) for i in (2, 3, 4)}
    assert of == {
        "3dgs-inria": {("r6", 0)}, "hac": ends | curve, "hac-plus": ends | curve, "lightgaussian": {("r3", 0)},
        "mesongs": {("r2", 0), ("r4", 0)}, "compact3dgs-synthetic": {("r5", 0), ("r7", 0)}, "c3dgs": {("r4", 0)},
    }  # fmt: skip
    assert all("background=black" in cell.sets for cell in chair if cell.method.startswith("hac"))
    assert {cell.scene.partition("/")[0] for cell in cells} == {"nerf_synthetic", "mipnerf360", "tandt", "db"}


def test_the_plan_of_the_cells_is_legal_and_leads_to_the_same_folders(script, tmp_path):
    demo = script.Cell("3dgs-inria", "3dgs", "demo:tiny", "r6", preset="inria", sets=("iterations=5",))
    cells = [replace(demo, seed=seed, rate=rate) for seed, rate in ((0, "r6"), (0, "r2"), (2, "r6"))]
    cells += [script.Cell("hac", "hac", "demo", "r1", 1, sets=("growth.init_factor=4", "background=black"))]
    file = tmp_path / "plan.toml"
    file.write_text(sys.modules["sweep_cells"].plan_text(cells))
    planned = cells_of(read_plan(file)[0], Layout(tmp_path / "out"), load_plugins())
    assert {cell.directory for cell in planned} == {cell.directory(tmp_path / "out") for cell in cells}
    (hac,) = [cell.resolved for cell in planned if cell.label == "hac"]
    assert (hac.config.growth.init_factor, hac.scene.background, hac.preset) == (4, "black", "paper")


def test_one_label_stands_for_one_configuration(script):
    cell = script.Cell("hac", "hac", "demo:tiny", "r1")
    with pytest.raises(ValueError, match="several configurations"):
        sys.modules["sweep_cells"].plan_text([cell, replace(cell, rate="r2", sets=("voxel_size=1",))])


def test_cells_are_run_once_and_stand_beside_what_was_published(script, bench, data, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = (out, "--only", "hac", "--only", "mic", "--gpus", "0,1", "--jobs", 10)
    status, fake = bench(script, *arguments, "--set", "iterations=5")
    told = capsys.readouterr().out
    assert status == 0
    assert fake.commands[0][:2] == ["bench", str(out / "cells.toml")]
    assert "workers=10" in fake.commands[0]
    assert fake.environments[0]["CUDA_VISIBLE_DEVICES"] == "0,1"
    assert '"iterations" = "5"' in (out / "cells.toml").read_text()
    assert len(fake.made) == 18
    assert "18 ran" in told
    assert "mic: nowhere" not in told
    assert "scene 'nerf_synthetic/mic' is not there" in told
    assert "34.05 ± 0.05" in told  # r1 of three seeds
    assert "overlap hac nerf_synthetic/chair: 38 %, published 34.73 to 35.49, here 34.05 to 36.05 dB" in told
    assert "background white here, black there" in told
    status, fake = bench(script, *arguments)
    told = capsys.readouterr().out
    assert (status, fake.made) == (0, [])
    assert "18 was there" in told
    assert "34.05 ± 0.05" in told


def test_bytes_at_equal_psnr_come_from_all_rate_points(script, bench, data, tmp_path, capsys):
    facts = tmp_path / "rows.json"
    bench(script, tmp_path / "out", "--only", "hac", "--json", facts)
    rows = {(row["label"], row["published"]["rate"]): row for row in json.loads(facts.read_text())}
    low = rows["hac", "r1"]
    assert [point["rate"] for point in low["curve"]] == ["r1", "r2", "r3", "r4", "r5"]
    # The published 34.726 dB lie between r2 (34.5 dB, one seed) and r3 (35.0).
    expected = 400_000 * 2 ** (2 + (34.726 - 34.5) / 0.5)
    assert low["at_equal"]["bytes"] == pytest.approx(expected)
    assert low["at_equal"]["ratio"] == pytest.approx(expected / 1_080_662)
    assert low["measured"]["psnr"] == pytest.approx([34.0, 34.05, 34.1])
    assert rows["hac-plus", "r1"]["at_equal"]["why"] == "0.15 dB below what is measured here"
    bench(script, tmp_path / "out", "--only", "hac", "--table", "--markdown")
    assert " hac r1 chair | 34.05 ± 0.05 | 34.73 | -0.68 |" in capsys.readouterr().out


def test_a_failure_is_told_with_its_reason(script, bench, data, tmp_path, capsys):
    status, _ = bench(script, tmp_path / "out", "--only", "lightgaussian", fails=("lightgaussian",))
    told = capsys.readouterr().out
    assert status == 1
    assert "failed: lightgaussian r3 nerf_synthetic/chair seed 0 CUDA out of memory" in told
    assert "1 failed" in told


def test_a_plan_lists_cells_and_runs_nothing(script, bench, data, tmp_path, capsys):
    status, fake = bench(script, tmp_path / "out", "--only", "mesongs r4", "--plan")
    told = capsys.readouterr().out
    assert (status, fake.commands) == (0, [])
    assert "1 to run" in told
    assert "measured beside published" not in told


@pytest.mark.parametrize(
    ("text", "hac", "other"), [("", 3, 1), ("1", 1, 1), ("hac=5", 5, 1), ("2,hac=5", 5, 2), ("hac=5,2", 5, 2)]
)
def test_seeds_are_a_number_for_all_or_for_a_method(script, text, hac, other):
    found = script.seeds_of(text)
    assert found.get("hac", found.get("", 1)) == hac
    assert found.get("3dgs", found.get("", 1)) == other
    with pytest.raises(ValueError):
        script.seeds_of("hac=0")


@pytest.fixture
def other_run(tmp_path: Path):
    """other_run(seed, **changes): keep a record of hac r1 on lego below tmp_path/h200, as a matrix of runs does."""
    ours = {"method": "hac", "rate": "r1", "preset": "paper", "dataset": "blender", "scene": "lego"}

    def kept(seed: int, **changes: object) -> None:
        folder = tmp_path / "h200" / f"seed-{seed}" / "lego" / "hac" / "r1"
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps({**RECORD, **ours, **changes}))

    return kept


@pytest.fixture
def lego(script):
    """The row of hac r1 on lego."""
    rows = script.rows_of(script.read_published())
    return next(r for r in rows if (r.label, r.figure.scene, r.figure.rate) == ("hac", "lego", "r1"))


def test_finished_runs_stand_for_a_row_with_their_mean_and_what_differs(
    script, bench, other_run, tmp_path, data, capsys
):
    other_run(0, metrics={"psnr": {"mean": 33.0}})
    other_run(1, metrics={"psnr": {"mean": 34.0}}, file={"bytes": 1236})
    other_run(2, preset="mcmc")
    other_run(3, rate="r2")
    other_run(4, dataset="colmap")  # another scene of that name
    shutil.copytree(data / "nerf_synthetic" / "chair", data / "nerf_synthetic" / "lego")
    arguments = ("--runs", tmp_path / "h200", "--only", "hac r1 nerf_synthetic/lego")
    _, fake = bench(script, tmp_path / "out", *arguments)
    told = capsys.readouterr().out
    assert fake.commands == []
    assert "33.50 ± 0.71" in told
    assert "1,235 ± 1" in told
    assert "background white here, black there" in told
    assert "2 test views here, 200 there" in told
    assert not any("differs: preset" in line for line in told.splitlines())


def test_a_record_that_cannot_be_read_is_told_once_and_left_out(script, lego, other_run, tmp_path, capsys):
    own = lego.cell(0).directory(tmp_path / "out")
    own.mkdir(parents=True)
    (own / "metrics.json").write_text("{")
    other_run(0, metrics={"psnr": {"mean": 33.0}})
    other_run(1, metrics=3)
    others = script.finished([tmp_path / "h200"])
    found = script.measured(lego, tmp_path / "out", others)
    assert [run.mean("psnr") for run in found.runs] == [33.0]
    script.print_table([found], script.Console(width=220))
    told, wrong = capsys.readouterr()
    assert "33.00" in told
    assert [line.split(": ")[1] for line in wrong.splitlines()] == [
        str(tmp_path / "h200" / "seed-1" / "lego" / "hac" / "r1" / "metrics.json"), str(own / "metrics.json"),
    ]  # fmt: skip


def test_runs_of_the_preset_that_is_meant_come_before_those_of_paper(script, lego, other_run, tmp_path):
    row = replace(lego, figure=lego.figure.model_copy(update={"preset": "inria"}))
    other_run(0)
    found = script.others_for(row, "r1", script.finished([tmp_path / "h200"]))
    assert [run.preset for run in found] == ["paper"]
    other_run(1, preset="inria")
    found = script.others_for(row, "r1", script.finished([tmp_path / "h200"]))
    assert [run.preset for run in found] == ["inria"]


def test_runs_of_another_label_are_not_those_of_a_row(script, lego, tmp_path):
    plain, other = lego.cell(1), replace(lego.cell(1), label="hac-10000-points")
    for cell in (plain, other):
        folder = cell.directory(tmp_path)
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps({**RECORD, "file": {"bytes": len(cell.label)}}))
    assert [run.file.bytes for run in script.own_runs(lego, "r1", tmp_path)] == [len("hac")]


def test_a_folder_of_runs_that_is_not_there_is_named(script, bench, tmp_path, capsys):
    with pytest.raises(SystemExit):
        bench(script, tmp_path / "out", "--runs", tmp_path / "nowhere")
    assert f"--runs: no folder {tmp_path / 'nowhere'}" in capsys.readouterr().err


def test_without_data_nothing_runs(script, bench, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    status, fake = bench(script, tmp_path / "out", "--only", "chair")
    told = capsys.readouterr().out
    assert (status, fake.commands) == (0, [])
    assert "$SPLATWIZARD_DATA is not set" in told
    assert "24 missing" in told


def test_the_deadline_asks_for_checkpoints(script, monkeypatch, tmp_path):
    cells, asked = sys.modules["sweep_cells"], []

    class Slow:
        def __init__(self, command, env):
            self.waited = 0

        def wait(self, timeout=None):
            self.waited += 1
            if self.waited == 1:
                raise cells.subprocess.TimeoutExpired("sw", timeout)
            return cells.INTERRUPTED

        def send_signal(self, number):
            asked.append(number)

    monkeypatch.setattr(cells.subprocess, "Popen", Slow)
    cell = script.Cell("3dgs", "3dgs", "demo:tiny", "r6")
    found = cells.run_cells([cell], tmp_path, Namespace(**{**NOTHING, "deadline": 0.1}))
    assert asked == [cells.signal.SIGTERM]
    assert found[cell] == cells.Outcome("unfinished", "interrupted, the same command goes on")


def test_the_matrix_has_ends_seeds_starts_curves_and_lego(starts, data, bench, tmp_path, capsys):
    lego = tmp_path / "lego"
    lego.mkdir()
    arguments = (tmp_path / "out", "--lego", f"nerf_synthetic:{lego}")
    status, fake = bench(starts, *arguments)
    told = capsys.readouterr().out
    assert status == 0
    assert "48 cells: 48 ran" in told
    names = {str(folder.relative_to(tmp_path / "out")) for folder in fake.made}
    assert "seed-2/chair/cat-3dgs/r6" in names
    assert "seed-0-hac-10000-points/chair/hac/r1" in names
    assert "seed-4/lego/hac-plus/r5" in names
    assert "seed-0/chair/hac-plus/r3" in names
    assert "APART" not in told  # spread and differences are 0.2 dB at most
    assert "34.05" in told
    assert "34.00 (-0.05)" in told


def test_the_matrix_shares_its_runs_with_the_table_of_what_is_published(starts, script, data, bench, tmp_path, capsys):
    _, fake = bench(starts, tmp_path / "out", "--methods", "hac")
    assert len(fake.made) == 11  # 100,000 points are the default
    capsys.readouterr()
    _, fake = bench(script, tmp_path / "out", "--only", "hac ", "--table")
    told = capsys.readouterr().out
    assert " hac r1 chair" in told
    assert "34.05 ± 0.05" in told


def test_a_spread_above_the_bar_is_marked(starts, data, bench, tmp_path, capsys):
    bench(starts, tmp_path / "out", "--methods", "hac", "--bar", "0.05")
    assert "APART" in capsys.readouterr().out


def test_the_table_of_removal_has_presets_and_scores_at_equal_counts(monkeypatch, bench, tmp_path, capsys):
    table = module("removal_table", monkeypatch)
    words = ("--scene", "demo:tiny", "--counts", "50,90", "--grown", "200", "--scores", "removal,opacity")
    status, fake = bench(table, tmp_path / "out", *words)
    told = capsys.readouterr().out
    assert status == 0
    assert len(fake.commands) == 1
    assert "19 cells: 19 ran" in told
    rows = {line.split("│")[1].strip(): line.split("│")[2:5] for line in told.splitlines() if line.count("│") == 5}
    assert set(rows) >= {"paper", "fast", "settled", "mcmc, trained on", "paper + removal", "mcmc + opacity"}
    assert [cell.strip() for cell in rows["mcmc + removal"]] == ["35.00", "35.00 (50)", ""]
    plan = read_plan(tmp_path / "out" / "cells.toml")
    assert plan is not None
    (cell,) = (c for c in table.rows_of("demo:tiny", [50], 200, ["opacity"], 1)["mcmc + opacity"][50])
    assert set(cell.sets) == {
        "pretrained.preset=mcmc", "pretrained.density.settings.cap=200", "prune.count=50", "prune.pruner=opacity",
        "pretrained.density.settings.stop=25000", "pretrained.density.settings.noise_stop=1000000",
        "pretrained.density.settings.terms_stop=1000000",
    }  # fmt: skip
    status, fake = bench(table, tmp_path / "out", *words)
    assert "19 cells: 19 was there" in capsys.readouterr().out


def test_the_ladder_of_wisp_has_its_families_beside_the_baselines(monkeypatch, bench, tmp_path, capsys):
    ladder = module("wisp_ladder", monkeypatch)
    words = ("--scene", "demo:tiny", "--only", "progressive", "--only", "hac", "--only", "without-removal")
    status, fake = bench(ladder, tmp_path / "out", *words)
    told = capsys.readouterr().out
    assert (status, len(fake.commands)) == (0, 1)
    assert "9 cells: 9 ran" in told
    assert "progressive over hac-plus" in told
    cells = ladder.cells_of("demo:tiny", "", 2, "quick")["without context"]
    assert {(cell.rate, cell.seed, cell.preset, cell.sets) for cell in cells} == {
        ("r3", seed, "quick", ("context.kind=none",)) for seed in (0, 1)
    }


def test_a_rung_is_told_at_equal_psnr(monkeypatch, tmp_path, capsys):
    ladder = module("wisp_ladder", monkeypatch)
    found = {"r2": (30.0, 100), "r3": (31.0, 200), "r4": (32.0, 400), "without removal": (30.5, 200)}
    monkeypatch.setattr(ladder, "measured", lambda cell, out: [found[cell.label if cell.label in found else cell.rate]]
                        if cell.label in ("wisp", "without-removal") else [])  # fmt: skip
    found["without-removal"] = found.pop("without removal")
    ladder.print_rungs(ladder.cells_of("demo:tiny", "", 1), tmp_path, ladder.Console(width=120))
    row = next(line for line in capsys.readouterr().out.splitlines() if "without removal" in line)
    assert [word for word in row.split() if word[0] in "+-.0123456789"] == ["-0.50", "1.000", "1.414", "1"]


def test_bytes_at_equal_psnr_stand_on_the_lower_hull(monkeypatch):
    ladder = module("wisp_ladder", monkeypatch)
    found = [(30.0, 100), (31.0, 400), (32.0, 400), (31.5, 1_000), (29.0, 150)]
    assert [each[0] for each in ladder.lower_hull(found)] == [30.0, 32.0]
    assert ladder.ratio(found, 31.0, 400) == pytest.approx(0.5)
    assert ladder.ratio(found, 29.5, 200) == pytest.approx(0.5)  # the smallest file
    assert ladder.ratio(found, 32.1, 400) is None


def test_cuts_stand_beside_files_without_layers_at_equal_psnr(monkeypatch, tmp_path, capsys):
    ladder = module("wisp_ladder", monkeypatch)
    groups = ladder.cells_of("demo:tiny", "", 1)
    found = {"r1": (30.0, 100), "r3": (32.0, 400)}
    monkeypatch.setattr(ladder, "measured", lambda cell, out: [found[cell.rate]] if cell.rate in found else [])
    cell = next(each for each in groups["progressive"] if each.rate == "r3")
    cuts = [
        {"packets": number, "bytes": size, "metrics": {"psnr": psnr}}
        for number, (psnr, size) in enumerate([(25.0, 50), (30.0, 150), (31.0, 300), (32.0, 600)], 1)
    ]
    cell.directory(tmp_path).mkdir(parents=True)
    (cell.directory(tmp_path) / "metrics.json").write_text(json.dumps({**RECORD, "method": "wisp", "prefixes": cuts}))
    ladder.print_prefixes(groups, tmp_path, ladder.Console(width=120))
    told = capsys.readouterr().out
    rows = [line.replace("│", " ").split() for line in told.splitlines() if "│" in line]
    assert rows == [
        ["1", "25.00", "50"],
        *(
            [str(number), f"{psnr:.2f}", str(size), str(flat), "1.500"]
            for number, psnr, size, flat in ((2, 30, 150, 100), (3, 31, 300, 200), (4, 32, 600, 400))
        ),
    ]
    assert "of the dB 94% with 25 % of the bytes, 90 % with 25%; BD rate of the curve +50.0 % over 29%" in told

"""tools/results.py: every table of README.md, docs/results.md and docs/formats.md is what its records say."""

from __future__ import annotations

import importlib
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    for name in ("results", "result_records", "trainer_records", "result_groups", "result_plots", "result_claims",
                 "result_published"):  # fmt: skip
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("results")


@pytest.fixture
def record(tools: ModuleType):
    return tools.read(ROOT / "docs" / "records" / "demo.jsonl")[0]


def test_every_table_is_what_its_records_say(tools):
    for page in tools.PAGES:
        text = page.read_text("utf-8")
        assert tools.MARKED.search(text), f"{page.name} has no table made from records"
        assert tools.filled(text) == text, "python tools/results.py tables"


def test_a_table_that_was_changed_by_hand_is_found(tools):
    page = tools.PAGES[1].read_text("utf-8")
    changed = re.sub(r"(<!-- table published-brief chair -->.*?)\d\d\.\d\d", r"\g<1>99.99", page, count=1, flags=re.S)
    assert changed != page
    assert tools.filled(changed) == page


def test_every_record_file_is_shown_and_every_record_is_read(tools):
    shown = {found[3] for page in tools.PAGES for found in tools.MARKED.finditer(page.read_text("utf-8"))}
    for path in tools.RECORDS.glob("*.jsonl"):
        assert path.stem in shown
        assert tools.read(path)
    assert {path.stem for path in (tools.RECORDS / "trainers").iterdir()} <= shown


def test_every_figure_shows_what_its_records_say(tools):
    shown = [found[3] for page in tools.PAGES for found in tools.MARKED.finditer(page.read_text("utf-8"))
             if found[2] == "plot"]  # fmt: skip
    assert sorted(shown) == ["formats-demo", "formats-fox", "formats-room", "fox", "lego", "room"]
    for scene in shown:
        assert not tools.result_plots.is_stale(scene), "python tools/results.py tables"


def test_a_figure_is_stale_once_a_record_differs(tools, record, tmp_path):
    pytest.importorskip("matplotlib")
    plots = tools.result_plots
    runs = [replace(record, rate=f"r{i}", bytes=1000 * i, psnr=30.0 + i, ssim=0.9) for i in (1, 2)]
    runs += [replace(record, method="hac", rate=rate, anchors=5, ssim=None) for rate in ("r1", "r1")]
    tools.write(runs, tmp_path / "x.jsonl")
    file = tmp_path / "rd.svg"
    assert plots.is_stale("x", tmp_path, file)
    plots.draw("x", tmp_path, file)
    assert not plots.is_stale("x", tmp_path, file)
    drawn = file.read_text("utf-8")
    assert "3DGS<" in drawn
    assert "HAC<" in drawn
    first, second = plots.panels(runs)
    assert [(line.name, line.dashed, line.points) for line in first.lines] == [
        ("3DGS", False, [(0.001, 31.0, None), (0.002, 32.0, None)]),
        ("HAC", True, [(record.bytes / 1e6, record.psnr, 0.0)]),
    ]
    assert [line.name for line in second.lines] == ["3DGS"]  # without a value there is no point
    tools.write([replace(runs[0], psnr=20.0), *runs[1:]], tmp_path / "x.jsonl")
    assert plots.is_stale("x", tmp_path, file)
    assert plots.shown("none", tmp_path) == "*No records of none yet.*\n"


def test_a_claim_is_held_where_ratio_and_loss_are(tools, record, tmp_path):
    exact = replace(record, method="3dgs", rate="r6", gaussians=100, psnr=30.0, seed=0)
    small = replace(record, method="mesongs", rate="r4", bytes=800, psnr=29.7, seed=0, default_rate=True)
    more = [replace(each, seed=1) for each in (exact, small)]
    tools.write([exact, small], tmp_path / "lego.jsonl")
    tools.write([exact, small, *more], tmp_path / "fox.jsonl")
    row = tools.table("claims", "all", tmp_path).splitlines()[2]
    told = "27.5x, -0.36 dB (NeRF-Synthetic)"
    # 24,800 bytes of .ply over 800: 31.0. The claim is for renderings, and fox is none.
    cells = "31.0 ± 0.0x, -0.30 ± 0.00 dB (n = 2) | **31.0x, -0.30 dB**"
    assert row == f"| MesonGS | r4 * | {told} | {cells} |"
    tools.write([exact, replace(small, psnr=29.5)], tmp_path / "lego.jsonl")
    assert "**" not in tools.table("claims", "all", tmp_path)
    tools.write([small], tmp_path / "lego.jsonl")
    assert tools.table("claims", "all", tmp_path).splitlines()[2].endswith("| - |")
    elsewhere = replace(small, repetition=2)  # no 3DGS of that matrix: beside the mean of all
    tools.write([exact, replace(exact, seed=1, psnr=31.0, gaussians=140), elsewhere], tmp_path / "lego.jsonl")
    assert tools.table("claims", "all", tmp_path).splitlines()[2].endswith("| 37.2x, -0.80 dB † |")
    tools.write([exact, small, elsewhere], tmp_path / "lego.jsonl")  # the one that can be compared
    assert tools.table("claims", "all", tmp_path).splitlines()[2].endswith("| **31.0x, -0.30 dB** |")
    tools.write([exact, small, replace(small, variant="own", psnr=29.0)], tmp_path / "lego.jsonl")
    assert [line.split(" | ")[0] for line in tools.table("claims", "all", tmp_path).splitlines()[2:4]] == [
        "| MesonGS", "| MesonGS (own)",
    ]  # fmt: skip
    other = [replace(r, repetition=2) for r in (replace(exact, psnr=29.0), small)]
    tools.write([exact, *other], tmp_path / "lego.jsonl")
    assert tools.table("claims", "all", tmp_path).splitlines()[2].endswith("| **31.0x, +0.70 dB** |")


def test_records_stand_beside_the_published_figures_of_the_whole_scene(tools, record, tmp_path):
    start = replace(record, method="3dgs", rate="r6", preset="paper", steps=30_000, psnr=33.0, bytes=2_000, seed=0)
    small = replace(start, method="mesongs", rate="r4", starts_from="3dgs", steps=3_000, psnr=32.5, gaussians=7)
    other = replace(small, variant="nerf_synthetic", preset="nerf_synthetic", psnr=99.0)
    begun = replace(small, variant="from fast", psnr=99.0)
    unknown = replace(small, method="chimerags", rate="r2")
    tools.write([start, replace(start, seed=1, psnr=34.0), small, other, begun, unknown], tmp_path / "lego.jsonl")
    _, _, exact, mesongs = tools.table("published", "lego", tmp_path).splitlines()
    assert exact.startswith("| 3DGS | r6 | 35.78 | 33.50 ± 0.71 | - | ")
    assert exact.endswith(", 2023 | background black here, white there<br>preset paper here, inria there |")
    assert mesongs.startswith("| MesonGS | r4 | 35.06 | 32.50 | 0.9801 | ")
    assert " | 4,697,206 | 2,000 | 291,928 | 7 | 1 | ShuzhaoXie/MesonGS e491557, " in mesongs
    assert "background not stated there<br>33,000 steps here, 38,000 there<br>" in mesongs
    exactly = replace(start, preset="inria", variant="inria", psnr=35.0)  # the preset that is meant comes first
    tools.write([start, exactly], tmp_path / "lego.jsonl")
    row = tools.table("published", "lego", tmp_path).splitlines()[2]
    assert row.startswith("| 3DGS | r6 | 35.78 | 35.00 |")
    assert "preset" not in row
    with pytest.raises(SystemExit, match="no published scene is known for 'fox'"):
        tools.table("published", "fox", tmp_path)


def test_a_trainer_stands_beside_ours_with_means_and_without_speeds_of_shared_gpus(tools, tmp_path):
    import trainer_records

    ours = trainer_records.Training(
        trainer="splatwizard", scene="room", plan="mcmc", steps=7000, seed=0, psnr=30.0, gaussians=9, per_second=800.0,
        peak_mib=100.0, device="GPU", date="2026-01-01", note="",
    )  # fmt: skip
    theirs = replace(ours, trainer="other 1.0", per_second=200.0, note="SSIM of its own")
    lines = [ours, replace(ours, seed=1, psnr=31.0), theirs, replace(theirs, seed=1, per_second=None)]
    (tmp_path / "trainers").mkdir()
    text = "".join(json.dumps(vars(line)) + "\n" for line in lines)
    (tmp_path / "trainers" / "x.jsonl").write_text(text, encoding="utf-8")
    row = tools.table("trainers", "x", tmp_path).splitlines()[2]
    assert row == "| room | mcmc | 7,000 | 30.50 ± 0.71 | 30.00 ± 0.00 | 800 | - | - | 100 | 100 | 2 |"
    (tmp_path / "trainers" / "x.jsonl").write_text('{"trainer": "x"}\n', encoding="utf-8")
    with pytest.raises(SystemExit, match="line 1"):
        tools.table("trainers", "x", tmp_path)


def test_mean_deviation_and_number_of_seeds(tools, record):
    runs = [replace(record, seed=i, psnr=30.0 + i, gaussians=100, bytes=1000) for i in range(3)]
    exact = [replace(run, rate="r6", bytes=24_800, default_rate=True) for run in runs]
    head, *rows = tools.quality_table([*runs, *exact])
    cell = {row[1]: dict(zip(head, row, strict=True)) for row in rows}
    assert cell["r1"]["PSNR dB"] == "31.00 ± 1.00"
    assert (cell["r1"]["n"], cell["r1"]["x"], cell["r6 *"]["x"]) == ("3", "24.8 ± 0.0", "1.0 ± 0.0")


def test_files_stand_in_the_order_of_their_bytes_with_what_they_come_from(tools, record):
    exact = replace(record, rate="r6", bytes=24_800, gaussians=100, default_rate=True, encode_s=0.125)
    spz = replace(exact, method="spz", rate="r2", bytes=1000, starts_from="3dgs", steps=0)
    chimera = replace(exact, method="chimerags", rate="r1", bytes=2000, taught_by=["3dgs"], default_rate=False)
    head, *rows = tools.formats_table([exact, chimera, spz])
    cells = [dict(zip(head, row, strict=True)) for row in rows]
    assert [(c["method"], c["bytes"], c["x"]) for c in cells] == [
        ("spz", "1,000", "24.8"), ("ChimeraGS", "2,000", "12.4"), ("3DGS", "24,800", "1.0"),
    ]  # fmt: skip
    assert [(c["rate"], c["starts from"], c["taught by"], c["steps"]) for c in cells] == [
        ("r2 *", "3dgs", "-", "-"), ("r1", "points", "3dgs", "2,000"), ("r6 *", "points", "-", "2,000"),
    ]  # fmt: skip


def test_starts_of_two_presets_are_compared_seed_by_seed(tools, record):
    usual = [replace(record, rate="r3", seed=i, psnr=30.0 + i, ssim=0.9, bytes=1000) for i in range(3)]
    fast = [replace(r, variant="fast-cpu", preset="fast-cpu", psnr=r.psnr + 0.5, bytes=1500) for r in usual[:2]]
    method = replace(usual[0], method="c3dgs", rate="r4", default_rate=True)
    begun = replace(method, variant="from fast-cpu", psnr=29.75, bytes=900)
    head, *rows = tools.starts_table([*usual, *fast, method, begun])
    assert head[2:4] == ["PSNR dB, `quick`", "`fast-cpu`"]
    assert [row[0] for row in rows] == ["3DGS", "C3DGS"]
    assert rows[0][2:5] == ["30.50 ± 0.71", "31.00 ± 0.71", "0.50 ± 0.00"]  # without the third seed
    assert rows[0][-2:] == ["1.50 ± 0.00", "2"]
    assert rows[1][1:] == ["r4 *", "30.00", "29.75", "-0.25", "0.9000", "0.9000", "1,000", "900", "0.90", "1"]
    with pytest.raises(SystemExit, match="compares two presets"):
        tools.starts_table([*usual, *fast, method, replace(begun, variant="from fast")])


@pytest.mark.parametrize(
    ("preset", "before", "expected"),
    [
        ("quick", {}, ""),
        ("quick", {"3dgs": "quick"}, ""),
        ("quick", {"3dgs": "fast-cpu"}, "from fast-cpu"),
        ("splatwizard", {"3dgs": "paper"}, "splatwizard"),  # 3dgs has no preset of that name
        ("splatwizard", {"3dgs": "quick"}, "splatwizard from quick"),
        ("paper", {"3dgs": None}, ""),  # a file, of which nobody knows
        ("fast-cpu", {}, "fast-cpu"),
    ],
)
def test_a_run_from_a_start_that_was_asked_for_is_a_variant(tools, preset, before, expected):
    from result_records import _variant

    from splatwizard_core.plugins import load_plugins

    assert _variant(preset, before, load_plugins()) == expected


def test_what_was_not_measured_alone_is_no_time(tools, record):
    shared = replace(record, default_rate=True, alone=False, fps_alone=False)
    head, row = tools.cost_table([shared])
    assert [row[head.index(name)] for name in ("train s", "FPS, its own", "FPS, one rasterizer for all")] == ["-"] * 3
    alone = replace(shared, alone=True, fps_alone=True, fps=200.0, default_fps=100.0, rasterizer="flash")
    _, row = tools.cost_table([alone])
    assert [row[head.index(name)] for name in ("FPS, its own", "FPS, one rasterizer for all")] == ["200", "100"]


def test_fresh_records_take_the_place_of_all_once_they_are_read(tools, record, tmp_path, monkeypatch):
    finished = ROOT / "tests" / "golden" / "runs_0_1" / "finished"
    path = tmp_path / "x.jsonl"
    tools.write([record], path)
    with pytest.raises(SystemExit, match="no metrics"):
        tools.collect([tmp_path], tmp_path, name="x", fresh=True)
    assert tools.read(path) == [record]
    tools.collect([finished], tmp_path, name="x", fresh=True)
    (found,) = tools.read(path)
    assert found.method == "speedy-splat"

    def full_disk(self, text, **_):
        self.open("w").write(text[:9])
        raise OSError("no space left")

    monkeypatch.setattr(Path, "write_text", full_disk)
    with pytest.raises(OSError, match="space"):
        tools.write([record], path)
    assert tools.read(path) == [found]


def test_runs_are_collected_and_replace_what_they_repeat(tools, tmp_path):
    finished = ROOT / "tests" / "golden" / "runs_0_1" / "finished"
    (path,) = tools.collect([finished], tmp_path)
    (found,) = tools.read(path)
    metrics = json.loads(next(finished.rglob("metrics.json")).read_text())
    assert (found.method, found.rate, found.bytes) == ("speedy-splat", "r3", metrics["file"]["bytes"])
    assert found.psnr == metrics["metrics"]["psnr"]["mean"]
    tools.write([replace(found, psnr=1.0), replace(found, seed=7)], path)
    tools.collect([finished], tmp_path)
    assert sorted((r.seed, r.psnr) for r in tools.read(path)) == [(found.seed, found.psnr), (7, found.psnr)]
    tools.write([replace(found, protocol="another")], path)
    tools.write([replace(found, protocol="another", seed=9)], path)
    with pytest.raises(SystemExit, match="several protocols"):
        tools.collect([finished], tmp_path)


def test_what_the_matrix_measured_alone_counts(tools, tmp_path):
    import shutil

    source = next((ROOT / "tests" / "golden" / "runs_0_1" / "finished").rglob("metrics.json"))
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(source, run)
    speed = {"fps": 900.0, "default_fps": {"standard": 300.0}, "drawn_by": {"flash": "flash"}}
    quiet = {"speed": speed, "memory": {"kind": "cuda", "peak_render_bytes": 5}}
    (run / "matrix.json").write_text(json.dumps({"command": "sw run", "processes_per_gpu": 3, "quiet": quiet}))
    (path,) = tools.collect([run], tmp_path / "records")
    (found,) = tools.read(path)
    assert (found.fps, found.default_fps, found.rasterizer, found.default_rasterizer) == (900, 300, "flash", "standard")
    assert (found.fps_alone, found.alone, found.command, found.render_bytes) == (True, False, "sw run", 5)


def test_a_line_that_is_no_record_is_named(tools, tmp_path):
    (tmp_path / "x.jsonl").write_text('{"method": "3dgs"}\n')
    with pytest.raises(SystemExit, match="line 1"):
        tools.table("cost", "x", tmp_path)
    with pytest.raises(SystemExit, match="no table is called"):
        tools.table("other", "x", tmp_path)

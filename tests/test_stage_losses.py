"""benchmarks/stage_losses.py: its rows are the stages of the run, and the last one is the run's file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import splatwizard_core

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SHORT = {"preset": "quick", "device": "cpu"}


@pytest.fixture
def rows_of(monkeypatch, tmp_path, capsys):
    """(run directory, *arguments) -> rows."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import stage_losses

    def rows(run: Path, *arguments: str) -> list[dict]:
        target = tmp_path / "rows.json"
        words = ["stage_losses.py", str(run), "--device", "cpu", "--json", str(target), *arguments]
        monkeypatch.setattr("sys.argv", words)
        assert stage_losses.main() == 0
        found = json.loads(target.read_text())
        told = capsys.readouterr().out
        assert all(row["stage"] in told for row in found)
        return found

    return rows


def encoded(run: Path, file: Path) -> int:
    return splatwizard_core.encode(run, file).stat().st_size


def test_rows_of_compact3dgs_end_in_its_file_and_post_processing_only_takes_bytes(tmp_path, rows_of):
    _, run = splatwizard_core.train(
        "compact3dgs", "demo:tiny", tmp_path / "out", iterations=12, rvq={"start": 10},
        codec={"settings": {"grid_step": 0.02, "grid_threshold": 0}}, **SHORT,
    )  # fmt: skip
    stages = [row for row in rows_of(run) if not row["aside"]]
    assert len(stages) == 7
    assert abs(stages[-1]["bytes"] - encoded(run, tmp_path / "file.swz")) < 1024  # less what the file requires
    sizes = [row["bytes"] for row in stages[2:]]
    assert sizes == sorted(sizes, reverse=True)
    assert stages[-1]["psnr"] == stages[-2]["psnr"]  # entropy codes lose nothing


def test_rows_of_lightgaussian_are_its_stages(tmp_path, rows_of):
    opened, run = splatwizard_core.train(
        "lightgaussian", "demo:tiny", tmp_path / "out", iterations=8, pretrained={"iterations": 20}, **SHORT
    )
    stages = [row for row in rows_of(run) if not row["aside"]]
    assert len(stages) == 7
    teacher, kept = stages[0]["gaussians"], opened.model.num_rows
    assert [row["gaussians"] for row in stages] == [teacher, *[kept] * 6]
    numbers = {"3DGS": 59, "pruned": 59, "recovered": 59, "truncated": 38, "distilled": 38}
    assert [row["bytes"] / 4 / row["gaussians"] for row in stages[:5]] == list(numbers.values())
    assert abs(stages[-1]["bytes"] - encoded(run, tmp_path / "file.swz")) < 1024
    shared = rows_of(run, "--set", "codec.settings.ratio=1")
    assert shared[6]["bytes"] < stages[6]["bytes"]


def test_what_is_no_run_is_told(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import stage_losses

    monkeypatch.setattr("sys.argv", ["stage_losses.py", str(tmp_path)])
    assert stage_losses.main() == 1
    assert "no run directory" in capsys.readouterr().err

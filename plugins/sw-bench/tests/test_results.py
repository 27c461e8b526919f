"""The table at the end of a sweep: means over the seeds, and why a run is missing."""

from __future__ import annotations

from sw_bench.results import table_of

from splatwizard_core.tooling import load_plugins


def row(**changes):
    usual = {
        "label": "a", "scene": "garden", "rate": "r1", "seeds": [0, 1], "means": {"bytes": 1_234_567.0, "psnr": 27.126},
        "deviations": {"bytes": 1000.0, "psnr": 0.04}, "failed": {}, "waiting": [],
        "steps": [30_000],
    }  # fmt: skip
    return usual | changes


def test_several_seeds_are_a_mean_with_its_deviation():
    headings, lines = table_of([row()], load_plugins())
    assert headings == ["method", "scene", "rate", "n", "PSNR", "MB", "steps"]
    assert lines == [["a", "garden", "r1", "2", "27.13 ± 0.04", "1.235 ± 0.001", "30,000"]]


def test_steps_are_those_of_the_trained_scene_and_the_methods_own():
    started, of_file = row(steps=[30_000, 5_000]), row(steps=[None, 0])
    assert [line[-1] for line in table_of([started, of_file], load_plugins())[1]] == ["30,000 + 5,000", "file + 0"]


def test_one_seed_is_a_value_and_metrics_stand_in_their_order():
    values = {"bytes": 1e6, "l1": 0.05, "ssim": 0.81234, "psnr": 27.0}
    headings, lines = table_of([row(seeds=[3], means=values, deviations={})], load_plugins())
    assert headings == ["method", "scene", "rate", "PSNR", "SSIM", "L1", "MB", "steps"]
    assert lines == [["a", "garden", "r1", "27.00", "0.8123", "0.0500", "1.000", "30,000"]]


def test_what_failed_or_was_not_run_is_told_with_its_seeds():
    missing = row(seeds=[], means={}, deviations={}, failed={"0": "no memory", "1": "no memory"}, waiting=[2],
                  steps=[])  # fmt: skip
    headings, lines = table_of([row(), missing], load_plugins())
    assert headings[-1] == ""
    assert [line[-1] for line in lines] == ["", "failed (seed 0, 1): no memory; not run (seed 2)"]
    assert lines[1][3:-1] == ["0", "-", "-", "-"]

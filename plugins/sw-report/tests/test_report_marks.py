"""Results table and its companions, beside the numbers: marks, best values, commands, mean curves."""

import re
import shlex

from sw_report import numbers
from sw_report.aggregate import dataset_tables
from sw_report.commands import command_of, commands_table
from sw_report.method_styles import styles_of
from sw_report.plots import mean_charts, section_bars
from sw_report.results_tables import config_table, cost_table, runs_table
from sw_report.runs import collect


def texts(table):
    return [[cell.text for cell in row.cells] for row in table.rows]


def test_times_beside_other_processes_are_marked_and_said(make_run, tmp_path):
    make_run(change=lambda c: c.update(contended={"decode": 0.25, "render": 0.5}))
    (run,) = collect([tmp_path]).runs
    table = runs_table([run])
    cells = dict(zip((column.name for column in table.columns), texts(table)[0], strict=True))
    marked = {name for name, text in cells.items() if text.endswith(numbers.SHARED)}
    assert marked == {"decode s", "FPS"}
    assert numbers.SHARED_NOTE in table.notes
    assert any("decode 25%, render 50%" in note for note in cost_table(run.facts).notes)


def test_times_of_an_idle_machine_carry_no_mark(make_run, tmp_path):
    make_run()
    table = runs_table(collect([tmp_path]).runs)
    assert not any(numbers.SHARED in text for row in texts(table) for text in row)
    assert numbers.SHARED_NOTE not in table.notes


def test_values_of_different_machines_are_marked_one_by_one(make_run, tmp_path):
    make_run("r1")
    make_run("r2", size=2000, change=lambda c: c["environment"].update(threads=1))
    table = runs_table(collect([tmp_path]).runs)
    cells = [dict(zip((column.name for column in table.columns), row, strict=True)) for row in texts(table)]
    assert [row["FPS"] for row in cells] == ["12.5ᵃ", "12.5ᵇ"]
    assert [row["PSNR dB"][-1].isdigit() for row in cells] == [True, True]
    (note,) = (note for note in table.notes if "different machines" in note)
    assert note.endswith("ᵃ cpu, A Processor, 2 threads; ᵇ cpu, A Processor, 1 thread.")


def test_the_best_of_each_column_is_marked_if_there_is_a_choice(make_run, tmp_path):
    make_run("r1", 16.0, size=1000)
    make_run("r2", 4.0, size=5000)
    assert not runs_table(collect([tmp_path]).runs).has_best  # of one method the best rate point is no news
    make_run("r1", 2.0, method="other", size=1000)
    runs = collect([tmp_path]).runs
    table = runs_table(runs)
    best = {(r.cells[0].text, c.name) for r in table.rows for c, cell in zip(table.columns, r.cells, strict=True)
            if cell.best}  # fmt: skip
    # FPS are equal; 1,000 bytes are the best of two runs.
    assert best == {("other", "PSNR dB"), ("other", "SSIM"), ("other", "MB"), ("toy", "MB")}


def test_speeds_that_cannot_be_compared_have_no_best(make_run, tmp_path):
    def speed(fps, **contended):
        return lambda c: (c["speed"].update(fps=fps), c.update(contended=contended))

    make_run(change=speed(10.0))
    make_run(method="other", change=speed(20.0))
    assert [row.cells[-1].best for row in runs_table(collect([tmp_path]).runs).rows] == [True, False]
    make_run("r2", method="other", size=2000, change=speed(30.0, render=0.5))
    assert not any(row.cells[-1].best for row in runs_table(collect([tmp_path]).runs).rows)


def test_the_command_of_each_run_can_be_given_again(make_run, tmp_path):
    config = {
        "config": {"iterations": 300, "prune": {"soft": [0.3, 0.5], "cap": None}},
        "pipeline": {"seed": 3}, "scene": {"images": "my pictures"},
        "provenance": {"iterations": "preset 'paper'", "prune.soft": "--set", "prune.cap": "--set", "seed": "--set",
                       "images": "--set", "lr": "rate 'r1'", "background": "data set 'db'", "log_every": "my.toml"},
    }  # fmt: skip
    directory = make_run(change=lambda c: c.update(config=config))
    (run,) = collect([tmp_path]).runs
    expected = [
        "sw", "run", "--method", "toy", "--scene", "garden", "--preset", "paper", "--rate", "r1", "--config", "my.toml",
        "--set", "prune.soft=[0.3, 0.5]", "--set", "prune.cap=none", "--seed", "3", "--set", "images=my pictures",
    ]  # fmt: skip
    assert shlex.split(command_of(run)) == expected
    (directory / "config.toml").write_text('scene = "mipnerf360/garden"\n')
    assert "--scene mipnerf360/garden " in command_of(run)
    (directory / "config.toml").write_text("damaged")
    assert "--scene garden " in command_of(run)
    assert texts(commands_table([run])) == [["toy r1", command_of(run)]]


def test_a_value_that_was_looked_up_stands_in_place_of_the_open_one(make_run, tmp_path):
    config = {"config": {"depth": None, "blocks": 7, "cap": None}, "provenance": {"blocks": "--set"}}
    plan = [{"stage": "toy", "iterations": 3, "tasks": [], "looked_up": {"depth": 14, "blocks": 66}}]
    make_run(change=lambda c: c.update(config=config, plan=plan))
    (run,) = collect([tmp_path]).runs
    assert texts(config_table(run.facts)) == [
        ["depth", "14", "looked up for the scene"], ["blocks", "7", "--set"], ["cap", "none", "default"],
    ]  # fmt: skip


def test_a_record_without_a_configuration_has_no_command(make_run, tmp_path):
    make_run(change=lambda c: c.update(config=None))
    assert commands_table(collect([tmp_path]).runs) is None


def test_small_sections_are_told_by_name(make_run, tmp_path):
    sections = {f"part-{i}": 1000 - 10 * i for i in range(20)}
    make_run(size=sum(sections.values()), change=lambda c: c["file"].update(sections=sections))
    legend = [name for _, name in section_bars(collect([tmp_path]).runs).legend]
    assert legend[0] == "part-0"
    assert legend[-1] == "smaller: part-15, part-16, part-17, part-18, part-19"


def test_files_that_are_not_compressed_are_marked(make_run, tmp_path):
    def stored_by(*coders):
        def change(content):
            parts = [{"kind": "coder", "name": name, "distribution": "sw-codecs", "version": "1"} for name in coders]
            content["phases"] = [{"phase": "encode", "provided_by": parts}]

        return change

    make_run("r1", change=stored_by("range"), size=1000)
    make_run("r2", change=stored_by("plain"), size=2000)
    make_run("r3", change=stored_by("plain", "range"), size=3000)  # something is compressed
    make_run("r4", change=stored_by("not-installed"), size=4000)
    table = runs_table(collect([tmp_path]).runs)
    assert [row[1] for row in texts(table)] == ["r1", "r2, float32", "r3", "r4"]
    assert "float32: the parameters as they were trained, not compressed." in table.notes


def test_means_over_scenes_are_drawn_as_curves(make_curve, make_run, tmp_path):
    for scene in ("a", "b"):
        make_curve("toy", scene=scene)
        make_curve("3dgs", 0.5, scene=scene)
    make_curve("lacking", scene="a")
    runs = collect([tmp_path]).runs
    (table,) = dataset_tables(runs)
    charts = mean_charts(table, runs, styles_of(runs))
    assert [figure.caption for figure in charts.figures] == ["PSNR, dB", "SSIM"]
    assert [name for _, name in charts.legend] == ["3dgs", "toy"]  # no mean, no curve
    told = re.findall(r"<title>(toy r1: [^<]*)</title>", charts.figures[0].svg)
    row = next(row for row in table.rows if (row.variant, row.rate) == ("toy", "r1"))
    assert told == [f"toy r1: {row.metrics['psnr']:.2f} dB at 0.001 MB"]
    assert charts.figures[0].svg.count('class="target"') == 8


def test_means_without_a_curve_are_not_drawn(make_run, tmp_path):
    for scene in ("a", "b"):
        make_run(scene=scene)
    runs = collect([tmp_path]).runs
    assert mean_charts(dataset_tables(runs)[0], runs, styles_of(runs)) is None

"""Files with cuts in reports: a row for each prefix, and a plot of their own."""

from __future__ import annotations

import csv
import io
import json

import pytest
from sw_report import exports, numbers
from sw_report.figures import write_figures
from sw_report.page import PageOptions, render_page
from sw_report.prefixes import prefix_charts, prefixes_table
from sw_report.runs import collect


def prefixes(content):
    content["prefixes"] = [
        {"packets": 1, "bytes": 300, "counts": {"num_gaussians": 400}, "metrics": {"psnr": 20.0, "ssim": 0.75}},
        {"packets": 2, "bytes": 600, "counts": {"num_gaussians": 800}, "metrics": {"psnr": 25.0}},
        {"packets": 3, "bytes": 1000, "counts": {"num_gaussians": 1234}, "metrics": {"psnr": 30.0, "ssim": 0.9}},
    ]


@pytest.fixture
def progressive(make_run):
    return make_run(change=prefixes)


def test_a_table_has_a_row_for_each_prefix(progressive):
    table = prefixes_table(collect([progressive]).runs[0])
    assert [column.name for column in table.columns][:4] == ["packets", "bytes", "share", "Gaussians"]
    assert [[cell.text for cell in row.cells] for row in table.rows] == [
        ["1", "300", "30.0%", "400", "20.00", "0.7500"],
        ["2", "600", "60.0%", "800", "25.00", numbers.MISSING],
        ["3", "1,000", "100.0%", "1,234", "30.00", "0.9000"],
    ]


def test_csv_and_json_have_them_and_no_other_file_has(progressive, make_run):
    make_run("r2")
    runs = collect([progressive.parents[3]]).runs
    rows = list(csv.DictReader(io.StringIO(exports.to_csv(runs))))
    told = [(row["Submethod"], row["Size [Bytes]"], row["#Gaussians"], row["SSIM"]) for row in rows]
    assert told[1:3] == [("r1 packets 1", "300", "400", "0.75000"), ("r1 packets 2", "600", "800", "")]
    assert [row["Submethod"] for row in rows] == ["r1", "r1 packets 1", "r1 packets 2", "r2"]
    assert rows[1]["PSNR"] == "20.0000"
    lines = [json.loads(line) for line in exports.to_json_lines(runs).splitlines()]
    assert [len(line["prefixes"]) for line in lines] == [3, 0]
    titles = [title for title, _ in exports.tables_of(collect([progressive]), anchor=None, partial=False, pareto=False)]
    assert "Prefixes of toy r1 on garden" in titles


def test_the_page_draws_the_curve_of_files_with_cuts_alone(progressive, make_run):
    page = render_page(collect([progressive]), PageOptions(pictures=False))
    assert "toy r1, 2 packets: 25.00 dB at" in page
    assert 'id="prefixes"' in page
    other = make_run("r2", method="other")
    both = render_page(collect([progressive, other]), PageOptions(pictures=False))
    assert "toy r1, 2 packets: 25.00 dB at" in both
    assert "Prefixes of the files" not in render_page(collect([other]), PageOptions(pictures=False))
    assert prefix_charts(collect([other]).runs, {"other": 0}) is None


def test_plots_for_papers_have_a_file_of_their_own(progressive, make_run, tmp_path):
    pytest.importorskip("matplotlib")
    make_run("r2", scene="other")
    names = [path.name for path in write_figures(collect([progressive.parents[3]]).runs, tmp_path / "plots")]
    assert [name for name in names if name.startswith("prefixes")] == ["prefixes-garden.svg", "prefixes-garden.pdf"]

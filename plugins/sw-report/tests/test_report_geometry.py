"""Geometry in tables and on the page: there where a run has it, and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from PIL import Image
from sw_report.distortion import bd_tables, drawn_metrics, with_values
from sw_report.dtu_table import dtu_table, published
from sw_report.exports import tables_of
from sw_report.geometry import geometry_parts
from sw_report.numbers import MISSING
from sw_report.page import PageOptions, render_page
from sw_report.results_tables import bd_table, metric_names
from sw_report.runs import collect

GEOMETRY = {
    "chamfer": {"protocol": "analytic", "unit": "scene", "acc": 0.0123, "comp": 0.0456, "mesh": {"voxel_size": 0.02}},
}


@pytest.fixture
def measured(make_run):
    """A run whose geometry was measured."""

    def change(content: dict[str, Any]) -> None:
        content["metrics"]["chamfer"] = {"mean": 0.029, "per_view": [], "direction": "lower"}
        content["geometry"] = GEOMETRY
        del content["unknown"]["geometry"]

    return make_run(method="3dgs", change=change)


def test_a_column_is_there_if_one_run_has_it(measured, make_run):
    without = make_run(method="hac")
    assert "chamfer" in metric_names(collect([measured, without]).runs)
    assert "chamfer" not in metric_names(collect([without]).runs)


def test_the_page_of_a_run_tells_what_its_values_consist_of(measured):
    (run,) = collect([measured]).runs
    (part,) = geometry_parts(run, pictures=True)
    assert [[cell.text for cell in row.cells] for row in part.table.rows] == [
        ["chamfer", "acc", "0.0123", "scene", "analytic"],
        ["chamfer", "comp", "0.0456", "scene", "analytic"],
    ]
    assert part.table.notes == ["chamfer, mesh: voxel_size 0.02."]
    page = render_page(collect([measured]), PageOptions())
    assert "0.0456" in page
    assert "is not understood" not in page


def test_pictures_that_were_kept_are_on_the_page(measured):
    folder = measured / "renders" / "geometry"
    folder.mkdir(parents=True)
    Image.fromarray(np.full((24, 32, 3), 200, dtype=np.uint8)).save(folder / "mesh.png")
    (folder / "broken.png").write_bytes(b"no picture")
    (run,) = collect([measured]).runs
    gallery = geometry_parts(run, pictures=True)[0].gallery
    assert [(row.name, row.shown[0].render.width) for row in gallery.rows] == [("mesh", 32)]
    assert geometry_parts(run, pictures=False)[0].gallery is None
    assert "Render of view mesh" in render_page(collect([measured]), PageOptions())


def test_a_run_without_geometry_has_no_such_section(make_run):
    run = make_run(method="hac")
    assert geometry_parts(collect([run]).runs[0], pictures=True) == []
    assert 'id="geometry"' not in render_page(collect([run]), PageOptions())


def with_distances(voxel: float = 0.02, factor: float = 1.0):
    """Give a record geometry whose distance falls as its PSNR rises."""

    def change(content: dict[str, Any]) -> None:
        content["geometry"] = {}
        distance = factor / content["metrics"]["psnr"]["mean"]
        for name, value, direction, details in (
            ("normal_error", 100 * distance, "lower", {}),
            ("chamfer", distance, "lower", {"unit": "scene", "mesh": {"voxel_size": voxel}}),
            ("mesh_f1", 1 - distance, "higher", {}),
        ):
            content["metrics"][name] = {"mean": value, "per_view": [], "direction": direction}
            content["geometry"][name] = details
        del content["unknown"]["geometry"]

    return change


def test_of_geometry_the_distance_alone_is_compared_and_smaller_is_the_gain(make_curve, tmp_path):
    make_curve("anchor", change=with_distances())
    make_curve("better", 0.5, change=with_distances())
    runs = collect([tmp_path]).runs
    tables = bd_tables(runs, "anchor")
    assert [table.metric for table in tables] == ["psnr", "ssim", "chamfer"] == drawn_metrics(runs)
    assert [table.lower for table in tables] == [False, False, True]
    (row,) = tables[2].rows
    assert row.rate.value == pytest.approx(-50)
    assert row.quality.value > 0
    shown = bd_table(tables[2])
    assert "chamfer" in shown.columns[2].name.lower()
    assert "positive is better: lower values" in shown.caption
    assert "lower values" not in bd_table(tables[0]).caption


def test_a_worse_surface_at_equal_bytes_is_a_loss(make_curve, tmp_path):
    make_curve("anchor", change=with_distances())
    make_curve("rough", change=with_distances(factor=1.05))
    (row,) = bd_tables(collect([tmp_path]).runs, "anchor")[2].rows
    assert row.rate.value > 0
    assert row.quality.value < 0


def test_meshes_of_other_voxels_are_not_compared(make_curve, tmp_path):
    make_curve("anchor", change=with_distances())
    make_curve("coarse", 0.5, change=with_distances(voxel=0.04))
    psnr, _, chamfer = bd_tables(collect([tmp_path]).runs, "anchor")
    assert psnr.rows[0].rate.value == pytest.approx(-50)
    assert chamfer.rows[0].rate.value is None
    assert chamfer.rows[0].rate.reason == "meshes with voxels of 0.02, 0.04 are not compared"
    kept, reasons = with_values([chamfer])
    assert kept == []
    assert [reason.lower() for reason in reasons] == [
        "no bd values by chamfer: meshes with voxels of 0.02, 0.04 are not compared."
    ]


def on_dtu(scan: int, distance: float):
    def change(content: dict[str, Any]) -> None:
        content["dataset"], content["protocol"]["dataset"] = "dtu", "dtu"
        content["metrics"]["chamfer_dtu"] = {"mean": distance, "per_view": [], "direction": "lower"}
        content["geometry"] = {"chamfer_dtu": {"protocol": "dtu-chamfer", "unit": "mm"}}
        del content["unknown"]["geometry"]

    return {"scene": f"scan{scan}", "change": change}


def test_published_rows_have_the_mean_of_their_scans():
    known = published()
    for each in known["rows"]:
        assert len(each["values"]) == len(known["scans"]) == 15
        assert each["mean"] == pytest.approx(float(np.mean(each["values"])), abs=0.0101)  # of values of two digits
        assert each.get("remark", next(iter(known["remarks"]))) in known["remarks"]


def test_distances_on_dtu_stand_beside_published_ones(make_run, tmp_path):
    assert dtu_table(collect([make_run(method="hac")]).runs) is None
    for i, scan in enumerate(published()["scans"]):
        make_run(method="2dgs", keep=(), **on_dtu(scan, 0.5 + i / 10))
    make_run(method="3dgs", keep=(), **on_dtu(24, 2.0))
    collection = collect([tmp_path])
    table = dtu_table(collection.runs)
    found = {row.cells[0].text: [cell.text for cell in row.cells[1:]] for row in table.rows}
    (whole,) = (cells for name, cells in found.items() if name.startswith("2dgs"))
    assert whole[:3] == ["measured", "0.50", "0.60"]
    assert whole[-1] == "1.20"
    (one,) = (cells for name, cells in found.items() if name.startswith("3dgs"))
    assert one[1] == "2.00"
    assert set(one[2:]) == {MISSING}
    assert found["2DGS, repository"][0] == "published"
    assert found["PGSR, paper ***"][-1] == "0.53"
    assert any(note.startswith("*** ") and "ICP" in note for note in table.notes)
    assert any(title == table.title for title, _ in tables_of(collection, anchor=None, partial=False, pareto=False))
    assert 'id="dtu"' in render_page(collection, PageOptions())

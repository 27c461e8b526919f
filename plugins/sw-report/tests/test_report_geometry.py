"""Geometry in tables and on the page: there where a run has it, and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from PIL import Image
from sw_report.geometry import geometry_parts
from sw_report.page import PageOptions, render_page
from sw_report.results_tables import metric_names
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

"""Quality against the distance from the training views: groups, rank correlation, and the page about it."""

import numpy as np
import pytest
from sw_report.by_scene import scene_charts
from sw_report.distance import distance_parts, reached, spearman, with_distances
from sw_report.figures import write_figures
from sw_report.method_styles import styles_of
from sw_report.runs import collect

from splatwizard_core.cli.main import main


def placed(distances, psnr, split="every8"):
    """Give a record these distances and values of its views."""

    def change(content):
        content["views"] = [f"v{i}.png" for i in range(len(psnr))]
        content["protocol"].update(id=f"colmap/images/r-1/{split}/black/pp-center/q8", split=split)
        content["metrics"]["psnr"] = {"mean": float(np.mean(psnr)), "per_view": list(psnr), "direction": "higher"}
        content["metrics"]["path_combined"] = {
            "mean": float(np.mean(distances)), "per_view": list(distances), "direction": "lower", "diagnostic": True,
        }  # fmt: skip

    return change


def test_views_fall_into_four_groups_of_equal_size_larger_ones_first(make_run, tmp_path):
    psnr = [30.0, 29.0, 28.0, 27.0, 26.0, 25.0, 24.0, 23.0, 22.0, 21.0]
    make_run(change=placed([float(i) for i in range(10)], psnr))
    (run,) = collect([tmp_path]).runs
    found = reached(run, "psnr")
    assert found is not None
    assert found.groups == [(1.0, 29.0), (4.0, 26.0), (6.5, 23.5), (8.5, 21.5)]  # 3, 3, 2, 2 views
    assert (found.fall, found.rank) == (7.5, pytest.approx(-1))


def test_equal_distances_are_ordered_by_name(make_run, tmp_path):
    make_run(change=placed([0.5] * 4, [30.0, 29.0, 28.0, 27.0]))
    (run,) = collect([tmp_path]).runs
    found = reached(run, "psnr")
    assert found is not None
    assert [value for _, value in found.groups] == [30.0, 29.0, 28.0, 27.0]
    assert found.rank is None  # fewer than 8 views


def test_ranks_of_ties_are_averaged():
    assert spearman([1, 2, 2, 3], [1, 2, 2, 3]) == pytest.approx(1)
    assert spearman([1, 2, 3, 4], [1, 1, 2, 2]) == pytest.approx(2 / 5**0.5)  # ranks 1.5 1.5 3.5 3.5
    assert spearman([1, 2, 3], [4, 4, 4]) is None


def test_records_without_distances_have_no_such_part(make_run, tmp_path, capsys):
    make_run()
    runs = collect([tmp_path]).runs
    assert with_distances(runs) == []
    assert distance_parts(runs, styles_of(runs)) == []
    assert main(["report", str(tmp_path), "--distance", str(tmp_path / "sheet.html")]) == 2
    assert "no record says how far its test views lie" in capsys.readouterr().err


def test_too_few_views_are_the_reason_where_they_are(make_run, tmp_path, capsys):
    make_run(change=placed([0.1, 0.2, 0.3], [30.0, 29.0, 28.0]))
    assert main(["report", str(tmp_path), "--distance", str(tmp_path / "sheet.html")]) == 2
    assert "no run has 4 test views whose distance and PSNR are known, a group each; the most is 3" in (
        capsys.readouterr().err
    )


def test_the_sheet_has_a_chart_and_a_table_of_each_scene_and_split(make_run, tmp_path):
    distances = [0.1 * i for i in range(8)]
    for scene in ("room", "chair"):
        for split, fall in (("every8", 0.1), ("sector:60@120", 1.0)):
            for method in ("toy", "3dgs"):
                make_run(method=method, scene=scene, out=tmp_path / "out" / split.partition(":")[0],
                         change=placed(distances, [30 - fall * i for i in range(8)], split))  # fmt: skip
    sheet, page = tmp_path / "sheet.html", tmp_path / "page.html"
    assert main(["report", str(tmp_path / "out"), "--distance", str(sheet), "--html", str(page)]) == 0
    text = sheet.read_text()
    assert text.count('<svg class="chart"') == text.count("<tbody>") == 4
    assert "room, sector:60@120: PSNR, dB" in text
    assert "room, protocol colmap/images/r-1/every8/black/pp-center/q8" in text
    assert "+6.0" in text  # (30 + 29) / 2 - (24 + 23) / 2
    assert page.read_text().count("How far from the training views it holds") == 4


def test_plots_draw_distances_beside_the_curves(make_run, tmp_path):
    pytest.importorskip("matplotlib")
    make_run(change=placed([0.1 * i for i in range(8)], [30.0 - i for i in range(8)]))
    files = write_figures(collect([tmp_path]).runs, tmp_path / "plots")
    assert [file.name for file in files][2:] == ["distance-garden.svg", "distance-garden.pdf"]
    assert "angle / 90°" in files[2].read_text()


def test_a_chart_scene_by_scene_has_their_names(make_run, tmp_path):
    for scene, value in (("room", 30.0), ("chair", 33.0)):
        make_run(scene=scene, change=placed([0.1] * 4, [value] * 4))
    runs = collect([tmp_path]).runs
    found = scene_charts(runs, styles_of(runs))
    assert found is not None
    psnr = found.figures[0].svg
    assert ">chair</text>" in psnr
    assert "toy r1 on room: 30.00 dB" in psnr
    assert scene_charts(runs[:1], styles_of(runs)) is None

"""Means over scenes, BD values over scenes, and how numbers are written."""

import pytest
from sw_report import numbers
from sw_report.aggregate import dataset_tables, mean
from sw_report.distortion import bd_metrics, bd_tables, choose_anchor, drawn_metrics, with_values
from sw_report.results_tables import (
    bd_table,
    environment_table,
    means_table,
    missing_metrics,
    phases_table,
    protocol_table,
    runs_table,
    served_table,
)
from sw_report.runs import collect

from splatwizard_core.cli.main import main
from splatwizard_core.errors import UserInputError


def texts(table):
    return [[cell.text for cell in row.cells] for row in table.rows]


def test_a_data_set_is_the_plain_mean_of_its_scenes(make_run, tmp_path):
    for scene, size, noise in (("a", 1000, 4.0), ("b", 4000, 16.0)):
        make_run(scene=scene, size=size, noise=noise)
    runs = collect([tmp_path]).runs
    (table,) = dataset_tables(runs)
    (row,) = table.rows
    assert table.scenes == ("a", "b")
    assert row.size == 2500
    assert row.metrics["psnr"] == pytest.approx((runs[0].mean("psnr") + runs[1].mean("psnr")) / 2)
    assert row.counts == {"num_gaussians": 1234}


def test_a_missing_scene_leaves_no_mean_unless_partial(make_run, tmp_path):
    make_run("r1", scene="a")
    make_run("r1", scene="b")
    make_run("r2", scene="b", size=3000)
    runs = collect([tmp_path]).runs
    (table,) = dataset_tables(runs)
    whole, lacking = table.rows
    assert whole.size == 1000
    assert (lacking.rate, lacking.missing, lacking.size, lacking.metrics["psnr"]) == ("r2", ("a",), None, None)
    assert texts(means_table(table))[1][:6] == ["toy", "r2", "1 of 2", "–", "–", "–"]
    assert means_table(table).notes == ["toy r2: no mean, a missing."]
    (table,) = dataset_tables(runs, partial=True)
    assert table.rows[1].size == 3000
    assert means_table(table).notes == ["toy r2: mean of what is there, a missing."]


def test_a_published_data_set_needs_all_its_scenes(make_run, tmp_path):
    for scene in ("train", "truck"):
        make_run(scene=scene, change=lambda c: c.update(dataset="tandt"))
    for scene in ("garden", "room"):
        make_run(scene=scene, change=lambda c: c.update(dataset="mipnerf360"))
    tables = {t.dataset: t for t in dataset_tables(collect([tmp_path]).runs)}
    assert tables["tandt"].rows[0].size == 1000
    assert tables["tandt"].title == "Tanks & Temples"
    (row,) = tables["mipnerf360"].rows
    assert len(row.missing) == 7
    assert row.size is None


def test_a_folder_named_with_the_prefix_of_its_data_set_is_the_published_scene(make_run, tmp_path):
    for scene in ("scan24", "37", "scan99"):
        make_run(scene=scene, change=lambda c: c.update(dataset="dtu"))
    (table,) = dataset_tables(collect([tmp_path]).runs)
    (row,) = table.rows
    assert (table.title, table.published, row.scenes, row.missing) == ("DTU", True, ("24", "37"), ())


def test_a_data_set_that_is_not_installed_has_the_scenes_that_the_runs_are_of(make_run, tmp_path):
    for scene in ("b", "a"):
        make_run(scene=scene, change=lambda c: c.update(dataset="theirs"))
    (table,) = dataset_tables(collect([tmp_path]).runs)
    assert (table.title, table.published, table.scenes) == ("theirs", False, ("a", "b"))


def protocol(images="images", resolution=-1, name="custom"):
    def change(content):
        content["protocol"].update(
            id=f"colmap/{images}/r{resolution}/every8/black/pp-center/q8", images=images, resolution=resolution,
            name=name,
        )  # fmt: skip

    return change


def test_scenes_may_differ_in_the_picture_folder_and_it_is_told(make_run, tmp_path):
    make_run(scene="outdoor", change=protocol("images_4"))
    make_run(scene="indoor", change=protocol("images_2"))
    (table,) = dataset_tables(collect([tmp_path]).runs)
    assert table.rows[0].size == 1000
    assert means_table(table).notes[-1].startswith("The scenes use different picture folders: ")


def test_other_protocols_never_share_a_mean(make_run, tmp_path):
    make_run(scene="a", change=protocol(resolution=-1))
    make_run(scene="b", change=protocol(resolution=4))
    assert dataset_tables(collect([tmp_path]).runs) == []


def test_one_scene_under_two_folders_is_two_tables(make_run, tmp_path):
    for rate, images in (("r1", "images_2"), ("r2", "images_4")):
        for scene in ("a", "b"):
            make_run(rate, scene=scene, change=protocol(images))
    tables = dataset_tables(collect([tmp_path]).runs)
    assert [(t.protocols, [r.rate for r in t.rows]) for t in tables] == [
        (("colmap/images_2/r-1/every8/black/pp-center/q8",), ["r1"]),
        (("colmap/images_4/r-1/every8/black/pp-center/q8",), ["r2"]),
    ]


def test_two_named_protocols_have_a_mean_each(make_run, tmp_path):
    for scene, images in (("outdoor", "images_4"), ("indoor", "images_2")):
        make_run("r1", scene=scene, change=protocol(images, name="inria"), out=tmp_path / "inria")
        make_run("r1", scene=scene, size=3000, change=protocol("images", name="survey"), out=tmp_path / "survey")
    tables = dataset_tables(collect([tmp_path]).runs)
    assert sorted((len(t.protocols), t.rows[0].size) for t in tables) == [(1, 3000), (2, 1000)]


def test_scenes_of_two_named_protocols_never_share_a_mean(make_curve, tmp_path):
    for scene, images, name in (("a", "images_4", "inria"), ("b", "images", "survey")):
        make_curve("anchor", scene=scene, change=protocol(images, name=name))
        make_curve("better", 0.5, scene=scene, change=protocol(images, name=name))
    runs = collect([tmp_path]).runs
    assert dataset_tables(runs) == []
    assert [[row.scene for row in table.rows] for table in bd_tables(runs, "anchor")] == [["a"], ["a"], ["b"], ["b"]]


def test_an_unknown_value_makes_an_unknown_mean():
    assert mean([1.0, None]) is None
    assert mean([1.0, None], partial=True) == 1.0
    assert mean([], partial=True) is None


def test_bd_rates_are_means_over_scenes_of_each_scenes_own(make_curve, tmp_path):
    for scene, saving in (("a", 0.5), ("b", 0.8)):
        make_curve("anchor", scene=scene)
        make_curve("better", saving, scene=scene)
    tables = bd_tables(collect([tmp_path]).runs, "anchor")
    assert [t.metric for t in tables] == ["psnr", "ssim"]
    rows = {(r.variant, r.scene): r for r in tables[0].rows}
    assert rows["better", "a"].rate.value == pytest.approx(-50)
    assert rows["better", "b"].rate.value == pytest.approx(-20)
    assert rows["better", None].rate.value == pytest.approx(-35)
    assert rows["better", "a"].quality.value > 0
    assert texts(bd_table(tables[0]))[0][:3] == ["better", "a", "−50.0"]


def test_a_scene_without_a_curve_leaves_no_mean_unless_partial(make_curve, make_run, tmp_path):
    make_curve("anchor", scene="a")
    make_curve("anchor", scene="b")
    make_curve("better", 0.5, scene="a")
    make_run("r1", method="better", scene="b")
    runs = collect([tmp_path]).runs
    rows = {r.scene: r for r in bd_tables(runs, "anchor")[0].rows}
    assert rows["b"].rate.value is None
    assert rows["b"].rate.reason == "a curve needs at least 2 points, that of better has 1"
    assert rows[None].rate.value is None
    assert rows[None].rate.reason == "1 of 2 scenes have no value"
    rows = {r.scene: r for r in bd_tables(runs, "anchor", partial=True)[0].rows}
    assert rows[None].rate.value == pytest.approx(-50)


def test_a_short_curve_of_the_anchor_is_the_one_that_is_named(make_curve, make_run, tmp_path):
    make_run("r1", method="anchor")
    make_curve("better", 0.5)
    (row,) = bd_tables(collect([tmp_path]).runs, "anchor")[0].rows
    assert row.rate.reason == row.quality.reason == "a curve needs at least 2 points, that of anchor has 1"


def test_curves_that_fall_have_no_bd_rate_but_with_pareto(make_curve, make_run, tmp_path):
    make_curve("anchor")
    make_curve("dented", 0.5)
    make_run("r5", noise=30.0, method="dented", size=40_000)
    runs = collect([tmp_path]).runs
    (row,) = bd_tables(runs, "anchor")[0].rows
    assert row.rate.value is None
    assert "in the curve of dented a larger file is not better in PSNR" in row.rate.reason
    assert "--pareto" in row.rate.reason
    (row,) = bd_tables(runs, "anchor", pareto=True)[0].rows
    assert row.rate.value == pytest.approx(-50)


def test_runs_of_different_protocols_are_not_compared(make_curve, tmp_path):
    make_curve("anchor", change=protocol(resolution=-1))
    make_curve("other", 0.5, change=protocol(resolution=4))
    assert bd_tables(collect([tmp_path]).runs, "anchor") == []


def test_every_metric_with_a_direction_has_bd_rates_a_strangers_too(make_curve, tmp_path):
    def with_more(content):
        psnr = content["metrics"]["psnr"]["mean"]
        for name, value, direction in (
            ("l1", 1 / psnr, "lower"), ("lpips_alex", 1 / psnr, "lower"), ("lpips_vgg_3dgs", 1 / psnr, "lower"),
            ("their_metric", 2 * psnr, "higher"), ("odd", 1 / psnr, "lower"), ("sideways", psnr, "neither"),
        ):  # fmt: skip
            content["metrics"][name] = {"mean": value, "per_view": [], "direction": direction}
        content["metrics"]["psnr_unrounded"] = {"mean": psnr, "direction": "higher", "diagnostic": True}
        content["metrics"]["broken"] = {"mean": None, "direction": "higher"}

    make_curve("anchor", change=with_more)
    make_curve("better", 0.5, change=with_more)
    runs = collect([tmp_path]).runs
    tables = bd_tables(runs, "anchor")
    assert [t.metric for t in tables] == [
        "psnr", "ssim", "lpips_vgg_3dgs", "lpips_alex", "l1", "odd", "their_metric",
    ]  # fmt: skip
    assert all(t.rows[0].rate.value == pytest.approx(-50) for t in tables)
    assert drawn_metrics(runs) == ["psnr", "ssim", "lpips_vgg_3dgs", "odd", "their_metric"]


def test_lower_is_better_is_turned(make_curve, tmp_path):
    def with_lpips(content):
        psnr = content["metrics"]["psnr"]["mean"]
        content["metrics"]["lpips_vgg_3dgs"] = {"mean": 1 / psnr, "per_view": [], "direction": "lower"}

    make_curve("anchor", change=with_lpips)
    make_curve("better", 0.5, change=with_lpips)
    table = bd_tables(collect([tmp_path]).runs, "anchor")[2]
    assert table.metric == "lpips_vgg_3dgs"
    assert table.rows[0].rate.value == pytest.approx(-50)
    assert table.rows[0].quality.value > 0


def test_the_anchor_is_the_usual_one_or_the_one_asked_for(make_run, tmp_path):
    make_run(method="3dgs")
    assert choose_anchor(collect([tmp_path]).runs, None) is None
    make_run(method="another")
    assert choose_anchor(collect([tmp_path]).runs, None) == "3dgs"
    make_run(method="hac")
    runs = collect([tmp_path]).runs
    assert choose_anchor(runs, None) == "hac"
    assert choose_anchor(runs, "another") == "another"
    with pytest.raises(UserInputError, match=r"--anchor hacc: no run is of it; there are 3dgs, another, hac"):
        choose_anchor(runs, "hacc")


def test_without_a_usual_anchor_the_alphabetically_first_is_it(make_run, tmp_path):
    for scene, method in (("a", "toy"), ("a", "another"), ("b", "aardvark")):  # not installed: toy, aardvark
        make_run(scene=scene, method=method)
    assert choose_anchor(collect([tmp_path]).runs, None) == "aardvark"


def test_an_anchor_with_two_presets_must_be_named_in_full(make_run, tmp_path):
    for preset in ("paper", "quick"):
        make_run(out=tmp_path / "o" / preset, change=lambda c, p=preset: c.update(preset=p))
    runs = collect([tmp_path / "o"]).runs
    assert choose_anchor(runs, "toy (quick)") == "toy (quick)"
    with pytest.raises(UserInputError, match=r"not unique: choose one of toy \(paper\), toy \(quick\)"):
        choose_anchor(runs, "toy")


def test_unknown_values_are_dashes_with_their_reason(make_run, tmp_path):
    def without(content):
        content["metrics"]["lpips_vgg"] = {"mean": None, "per_view": [], "direction": "lower"}
        content["metrics"]["ssim"] = {"mean": None, "per_view": [None] * 5, "direction": "higher"}
        content["codec"]["encode_s"] = None
        content["unknown"].update({"metrics.lpips_vgg.mean": "no weights", "metrics.ssim.mean": "infinite"})

    make_run(change=without)
    runs = collect([tmp_path]).runs
    table = runs_table(runs)
    named = dict(zip([c.name for c in table.columns], table.rows[0].cells, strict=True))
    assert (named["SSIM"].text, named["SSIM"].title) == ("–", "infinite")
    assert named["encode s"].text == "–"
    assert "LPIPS (VGG)" not in named  # nobody has a value: a reason, no column
    assert missing_metrics(runs) == ["SSIM: infinite", "LPIPS (VGG): no weights"]


def test_protocols_stand_side_by_side_and_their_differences_are_marked(make_run, tmp_path):
    make_run("r1")
    make_run("r2", change=protocol(resolution=4))
    rows = {row[0]: row[1:] for row in texts(protocol_table(collect([tmp_path]).runs))}
    assert rows["resolution"] == ["-1", "4", "differs"]
    assert rows["split"] == ["every8", "every8", ""]


def test_environments_and_servants_are_told(make_run, tmp_path):
    make_run("r1")
    make_run("r2", change=lambda c: c["rasterizers"].update(train={"BACKWARD": "reference"}))
    runs = collect([tmp_path]).runs
    assert texts(served_table(runs)) == [
        ["toy", "garden toy r1", "sw-toy 0.1, layout 1", "standard (BACKWARD)", "standard (SPLIT_SH)"],
        ["toy", "garden toy r2", "sw-toy 0.1, layout 1", "reference (BACKWARD)", "standard (SPLIT_SH)"],
    ]
    assert ["sw-toy", "0.1"] in texts(environment_table(runs))


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        (numbers.megabytes(1_580_418), "1.580"),
        (numbers.megabytes(57_140_319), "57.14"),
        (numbers.megabytes(734e6), "734.0"),
        (numbers.seconds(396.4), "396"),
        (numbers.seconds(0.123), "0.12"),
        (numbers.percent(-12.34), "−12.3"),
        (numbers.counts({"num_gaussians": 1234}), "1,234"),
        (numbers.counts({"num_anchors": 12, "num_gaussians": 120}), "12 anchors / 120"),
    ],
)
def test_numbers_are_written_alike_everywhere(written, expected):
    assert written == expected


def test_metrics_are_written_as_they_declare():
    assert numbers.score("psnr", 27.2049) == "27.20"
    assert numbers.score("ssim", 0.81554) == "0.8155"
    assert numbers.score("ssim", None) == "–"
    assert numbers.heading("psnr") == "PSNR dB"
    assert numbers.heading("LPIPS-VGG") == "LPIPS (VGG)"
    assert numbers.heading("edge-psnr") == numbers.heading("edge_psnr") == "Edge PSNR dB"
    assert numbers.score("edge-psnr", 15.30941) == "15.31"


def test_a_diagnostic_metric_is_shown_by_its_exact_name():
    assert numbers.heading("psnr_unrounded") == "psnr_unrounded"
    assert numbers.score("psnr_unrounded", 27.2049) == "27.20"


@pytest.mark.parametrize("name", ["not_installed", "odd"])
def test_a_metric_that_declares_nothing_of_use_is_shown_by_its_name(name):
    assert numbers.heading(name) == name
    assert numbers.score(name, 0.81554) == "0.8155"
    assert numbers.ordered_metrics([name, "l1", "psnr"]) == ["psnr", "l1", name]


def test_the_fields_own_lpips_comes_first():
    names = ["l1", "lpips_vgg", "toy", "lpips_vgg_3dgs", "ssim", "psnr", "psnr"]
    assert numbers.ordered_metrics(names) == ["psnr", "ssim", "lpips_vgg_3dgs", "lpips_vgg", "l1", "toy"]
    assert numbers.main_lpips(names) == "lpips_vgg_3dgs"
    assert numbers.main_lpips(["psnr"]) is None


def test_phases_say_who_served_by_distribution(make_run, tmp_path):
    make_run("r1")
    make_run("r2", size=2000)
    make_run("r1", method="other", change=lambda content: content.update(phases=None))
    who = "garden toy r1, garden toy r2"
    assert texts(phases_table(collect([tmp_path]).runs)) == [
        ["toy", who, "train: toy", "sw-toy 0.1: stage toy; sw-rasterizers 0.2: rasterizer standard"],
        ["toy", who, "encode", "sw-toy 0.1: method toy"],
    ]


def test_records_that_do_not_tell_phases_have_no_such_table(make_run, tmp_path):
    make_run(change=lambda content: content.update(phases=None))
    (run,) = collect([tmp_path]).runs
    assert phases_table([run]) is None


def test_what_a_training_started_from_is_said(make_run, tmp_path):
    trained = {"file": {}, "preset": "quick", "config": {}, "steps": 2000, "train_s": 45.0, "made_by": {}}
    given = {"file": {"name": "a.ply", "sha256": "00"}, "preset": None, "config": None, "steps": None, "train_s": None,
             "made_by": {}}  # fmt: skip
    for rate, scene in (("r1", trained), ("r2", given)):
        make_run(rate, change=lambda content, scene=scene: content["train"].update(pretraining={"3dgs": scene}))
    told = {run.facts.rate: run.facts.started_from() for run in collect([tmp_path]).runs}
    assert told["r1"] == "a trained 3dgs scene (quick preset, 2,000 steps, 45.0 s)"
    assert told["r2"] == "a trained 3dgs scene from the file a.ply"


def test_diagnostic_metrics_stand_in_no_table_even_of_records_that_do_not_say_so(make_run, tmp_path):
    def with_diagnostic(content):
        content["metrics"]["psnr_unrounded"] = {"mean": 30.0, "per_view": [], "direction": "higher"}
        content["metrics"]["their_check"] = {"mean": 1.0, "per_view": [], "direction": "higher", "diagnostic": True}

    for scene in ("a", "b"):
        make_run(scene=scene, change=with_diagnostic)
    runs = collect([tmp_path]).runs
    (means,) = dataset_tables(runs)
    heads = [column.name for table in (runs_table(runs), means_table(means)) for column in table.columns]
    assert not {"psnr_unrounded", "their_check"} & set(heads)
    assert bd_metrics(runs) == ["psnr", "ssim"]


def test_a_diagnostic_metric_is_a_column_where_it_is_named(make_run, tmp_path, capsys):
    for scene, value in (("a", 30.0), ("b", 31.0)):
        make_run(scene=scene, change=lambda content, value=value: content["metrics"].update(
            cc_psnr={"mean": value, "per_view": [], "direction": "higher", "diagnostic": True}))  # fmt: skip
    assert main(["report", str(tmp_path), "--markdown", "--columns", "rate,cc_psnr"]) == 0
    told = capsys.readouterr().out
    assert [line for line in told.splitlines() if line.startswith("| toy")] == [
        "| toy | r1 | 30.0000 |", "| toy | r1 | 31.0000 |", "| toy | r1 | 30.5000 |",
    ]  # fmt: skip
    assert main(["report", str(tmp_path), "--markdown", "--columns", "all"]) == 0
    assert "cc_psnr" not in capsys.readouterr().out


def test_the_anchor_is_one_whose_curve_overlaps_and_it_is_said(make_curve, tmp_path):
    make_curve("3dgs")
    make_curve("toy", 0.5)
    make_curve("hac", change=lambda c: c["metrics"]["psnr"].update(mean=c["metrics"]["psnr"]["mean"] - 30))
    runs = collect([tmp_path]).runs
    assert choose_anchor(runs, None) == "3dgs"
    (table,) = (t for t in bd_tables(runs, "3dgs") if t.metric == "psnr")
    assert table.chosen == "The anchor is 3dgs; hac shares a range of PSNR with 0 other curves."
    assert bd_table(table).caption.startswith(table.chosen)
    assert bd_tables(runs, "hac")[0].chosen == "The anchor is hac."


def test_tables_without_a_bd_value_are_left_out_with_their_reasons(make_run, tmp_path):
    make_run("r1", method="3dgs")
    make_run("r1", method="toy")
    kept, reasons = with_values(bd_tables(collect([tmp_path]).runs, "3dgs"))
    assert kept == []
    assert reasons == ["No BD values by PSNR, SSIM: a curve needs at least 2 points, that of 3dgs has 1."]

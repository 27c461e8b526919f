"""CSV, JSON, Markdown and LaTeX for other programs, and `sw report` itself."""

import csv
import io
import json
import re

import pytest
from sw_report import exports
from sw_report.latex import methods_by_datasets, to_latex
from sw_report.results_tables import runs_table
from sw_report.runs import collect
from sw_report.selection import PAPER, selected

from splatwizard_core.cli.main import main


def test_the_surveys_files_have_its_columns_and_places(make_run, tmp_path):
    for rate in ("r2", "r1"):
        make_run(rate, size=1000 if rate == "r1" else 2000)
    make_run("r1", scene="room", method="hac")
    files = exports.write_survey(collect([tmp_path / "out"]).runs, tmp_path / "survey")
    assert [str(f.relative_to(tmp_path / "survey")) for f in files] == [
        "colmap/garden/toy.csv", "colmap/room/hac.csv",
    ]  # fmt: skip
    rows = list(csv.DictReader(files[0].open()))
    assert list(rows[0]) == ["Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians"]
    assert [(r["Submethod"], r["Size [Bytes]"], r["#Gaussians"], r["LPIPS"]) for r in rows] == [
        ("r1", "1000", "1234", ""), ("r2", "2000", "1234", ""),
    ]  # fmt: skip
    record = json.loads((tmp_path / "out/garden/toy/r1/metrics.json").read_text())
    assert float(rows[0]["PSNR"]) == pytest.approx(record["metrics"]["psnr"]["mean"], abs=5e-5)


def test_no_other_lpips_passes_for_the_surveys(make_run, tmp_path):
    def other_form_alone(content):
        content["metrics"]["lpips_vgg_3dgs"] = {"mean": None, "per_view": [], "direction": "lower"}
        content["metrics"]["lpips_alex"] = {"mean": 0.25, "per_view": [], "direction": "lower"}

    make_run("r1", change=other_form_alone)
    runs = collect([tmp_path / "out"]).runs
    (file,) = exports.write_survey(runs, tmp_path / "survey")
    assert [row["LPIPS"] for row in csv.DictReader(file.open())] == [""]
    (row,) = csv.DictReader(io.StringIO(exports.to_csv(runs)))
    assert (row["LPIPS"], row["LPIPS variant"]) == ("0.25000", "lpips_alex")


def test_two_protocols_of_a_scene_never_share_a_survey_file(make_run, tmp_path):
    make_run("r1")
    make_run("r2", change=lambda c: c["protocol"].update(id="another"))
    files = exports.write_survey(collect([tmp_path / "out"]).runs, tmp_path / "survey")
    assert len({f.parent for f in files}) == 2


def test_names_of_survey_files_stay_inside_the_folder(make_run, tmp_path):
    make_run(change=lambda c: c.update(scene="../../etc", method="..", dataset="/a\0b"))
    (file,) = exports.write_survey(collect([tmp_path / "out"]).runs, tmp_path / "survey")
    assert (tmp_path / "survey").resolve() in file.resolve().parents


def test_csv_holds_every_run_and_no_formula(make_run, tmp_path):
    make_run("=cmd|' /C calc'!A0")
    make_run("r2", size=2000, method='a,"b"')
    rows = list(csv.DictReader(io.StringIO(exports.to_csv(collect([tmp_path]).runs))))
    assert {r["Method"] for r in rows} == {"toy", 'a,"b"'}
    assert {r["Submethod"][0] for r in rows} == {"'", "r"}
    assert all(r["Protocol"] == "colmap/images/r-1/every8/black/pp-center/q8" for r in rows)


def test_latex_compiles_in_shape_and_escapes(make_curve, tmp_path):
    make_curve("my_method & 100%")
    make_curve("3dgs", 2.0)
    collection = collect([tmp_path])
    tables = exports.tables_of(collection, anchor="3dgs", partial=False, pareto=False)
    text = to_latex(tables, ["50 % of\nnothing"])
    assert text.startswith("% 50 % of nothing\n")
    assert r"my\_method \& 100\% & r1 &" in text
    body = text.split("\n", 1)[1]
    assert not re.search(r"(?<!\\)[_%#]", body)
    for environment in ("table", "tabular"):
        assert body.count(rf"\begin{{{environment}}}") == body.count(rf"\end{{{environment}}}") == len(tables)
    for table in body.split(r"\begin{tabular}{")[1:]:
        columns = table.index("}")
        lines = [line for line in table.splitlines() if line.rstrip().endswith(r"\\")]
        assert all(len(re.findall(r"(?<!\\)&", line)) == columns - 1 for line in lines)
    assert "$-$50.0" in body


def test_latex_has_bold_bests_labels_and_no_advice(make_curve, tmp_path):
    def without_weights(content):
        content["metrics"]["lpips_vgg"] = {"mean": None, "per_view": [], "direction": "lower"}
        content["unknown"]["metrics.lpips_vgg.mean"] = "weights-missing: pip install 'sw-metrics[lpips]'"

    make_curve("toy", change=without_weights)
    make_curve("3dgs", 2.0, change=without_weights)
    collection = collect([tmp_path])
    tables = exports.tables_of(collection, anchor="3dgs", partial=False, pareto=False)
    text = to_latex(tables, [], collection.runs)
    labels = re.findall(r"\\label\{(.*?)\}", text)
    assert labels == ["tab:garden", "tab:psnr-db-against-3dgs", "tab:ssim-against-3dgs"]
    assert text.count(r"\textbf{") == 5  # PSNR and SSIM of both r4, which are equal; the smallest file; FPS are equal
    assert "pip" not in text
    assert "LPIPS (VGG): weights-missing" in text
    paper = [(title, selected(table, PAPER)) for title, table in tables]
    assert "weights-missing" not in to_latex(paper, [], collection.runs)  # of a column that is not there


def test_latex_has_six_columns_arrows_and_names_as_published(make_curve, tmp_path, capsys):
    def with_lpips(content):
        for name, value in (("lpips_vgg_3dgs", 0.25), ("lpips_alex", 0.125)):
            content["metrics"][name] = {"mean": value, "per_view": [], "direction": "lower"}

    make_curve("hac-plus", change=with_lpips)
    make_curve("3dgs", 2.0, change=with_lpips)
    assert main(["report", str(tmp_path), "--latex"]) == 0
    head, *rows = [line.strip() for line in capsys.readouterr().out.splitlines() if line.endswith(r" \\")][:9]
    assert head.count("&") == 5
    for name, arrow in (("PSNR dB", "up"), ("SSIM", "up"), ("LPIPS (VGG, 3DGS)", "down"), ("MB", "down")):
        assert rf"{name} $\{arrow}arrow$" in head
    assert "0.125" not in rows[0]
    assert [row.split(" & ")[0] for row in rows] == ["3DGS"] * 4 + ["HAC++"] * 4


def test_columns_are_chosen_in_order_for_every_table(make_curve, tmp_path, capsys):
    make_curve("toy", scene="a")
    make_curve("toy", scene="b")
    assert main(["report", str(tmp_path), "--markdown", "--columns", "size,rate,scenes"]) == 0
    heads = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| method")]
    assert heads == ["| method | MB | rate |", "| method | MB | rate |", "| method | MB | rate | scenes |"]
    assert main(["report", str(tmp_path), "--columns", "size,psrn"]) == 2
    assert "--columns has no 'psrn': did you mean 'psnr'? It knows" in capsys.readouterr().err
    assert main(["report", str(tmp_path), "--columns", "nothing"]) == 2
    assert "--columns has no 'nothing': one or more of" in capsys.readouterr().err
    assert main(["report", str(tmp_path), "--markdown", "--columns", "size,steps"]) == 0
    told = capsys.readouterr().out
    assert main(["report", str(tmp_path), "--markdown", "--columns", "bytes,iterations"]) == 0  # as records say
    assert capsys.readouterr().out == told
    assert main(["report", str(tmp_path), "--columns", "size", "--csv"]) == 2


def test_notes_are_about_the_columns_that_are_shown(make_run, tmp_path):
    make_run(change=lambda content: content.update(contended={"train": 0.5}))
    table = runs_table(collect([tmp_path]).runs)
    assert any("Other processes" in note for note in selected(table, None).notes)
    assert any("Other processes" in note for note in selected(table, ["train"]).notes)
    assert not any("Other processes" in note for note in selected(table, PAPER).notes)


def test_rate_points_stand_in_their_order_whatever_their_sizes(make_run, tmp_path):
    sizes = {"r1": 5000, "r2": 1000, "r10": 2000}
    for rate, size in sizes.items():
        make_run(rate, size=size)
    assert [run.facts.rate for run in collect([tmp_path]).runs] == list(sizes)


def test_an_anchor_that_compares_with_nothing_says_why(make_curve, make_run, tmp_path, capsys):
    make_curve("3dgs")
    make_curve("hac", change=lambda c: c["metrics"]["psnr"].update(mean=c["metrics"]["psnr"]["mean"] - 30))
    make_run("r1", method="toy")
    assert main(["report", str(tmp_path), "--anchor", "toy", "--csv"]) == 0
    told = capsys.readouterr().err
    assert "--anchor toy: No BD values by PSNR, SSIM: a curve needs at least 2 points, that of toy has 1." in told
    assert re.search(r"garden: PSNR dB of 3dgs [\d.]+ to [\d.]+, hac -?[\d.]+ to [\d.]+, toy ", told)
    assert main(["report", str(tmp_path), "--anchor", "3dgs", "--csv"]) == 0
    assert "--anchor" not in capsys.readouterr().err


def test_latex_of_several_data_sets_begins_with_methods_by_data_sets(make_run, tmp_path):
    for dataset, scenes in (("theirs", ("a", "b")), ("tandt", ("train",)), ("single", ("c",))):
        for scene in scenes:
            for method, noise in (("toy", 8.0), ("3dgs", 4.0)):
                make_run(method=method, scene=scene, noise=noise, change=lambda c, d=dataset: c.update(dataset=d))
    runs = collect([tmp_path]).runs
    first = methods_by_datasets(runs)
    assert first.count(r"\multicolumn{3}{c}") == 3  # PSNR, SSIM, MB
    assert r"\multicolumn{3}{c}{theirs}" in first
    assert r"\multicolumn{3}{c}{train}" in first  # the other scene of its data set is missing: no mean
    lines = [line for line in first.splitlines() if line.strip().startswith(("toy", "3DGS"))]
    assert len(lines) == 2
    assert all(len(re.findall(r"(?<!\\)&", line)) == 10 for line in lines)
    assert lines[0].count(r"\textbf{") == 6
    assert first.count("{") == first.count("}")
    assert to_latex([], [], runs).startswith(r"\begin{table*}")
    assert methods_by_datasets([run for run in runs if run.facts.scene == "c"]) == ""


def test_markdown_tables_keep_their_columns(make_run, tmp_path):
    make_run(change=lambda c: c.update(method="a|b*c"))
    tables = exports.tables_of(collect([tmp_path]), anchor=None, partial=False, pareto=False)
    lines = [line for line in exports.to_markdown(tables, []).splitlines() if line.startswith("|")]
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) == 1
    assert r"a\|b\*c" in lines[2]


@pytest.fixture
def out(make_curve, tmp_path):
    make_curve("toy")
    make_curve("3dgs", 2.0)
    return tmp_path / "out"


def test_the_command_prints_text_tables(out, capsys):
    assert main(["report", str(out)]) == 0
    text = capsys.readouterr().out
    assert "garden, protocol colmap/images/r-1/every8/black/pp-center/q8" in text
    assert "PSNR dB against 3dgs" in text
    assert "−50.0" in text


def test_json_holds_runs_means_and_bd_values(out, capsys):
    assert main(["report", str(out), "--json", "--anchor", "toy"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found["runs"]) == 8
    assert found["anchor"] == "toy"
    (row,) = found["bd"][0]["rows"]
    assert (row["variant"], row["rate"]["value"]) == ("3dgs", pytest.approx(100))
    assert found["runs"][0]["sections"]["header"] == 100


def test_json_lines_are_one_run_each(out, capsys):
    assert main(["report", str(out), "--jsonl"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sorted({json.loads(line)["method"] for line in lines}) == ["3dgs", "toy"]
    assert len(lines) == 8


@pytest.mark.parametrize(
    ("option", "begin"), [("--csv", "Dataset,"), ("--latex", r"\begin{table}"), ("--markdown", "**")]
)
def test_other_forms_go_to_stdout_alone(out, capsys, option, begin):
    assert main(["report", str(out), option]) == 0
    assert capsys.readouterr().out.startswith(begin)


def test_files_are_written_where_asked_and_said_on_stderr(out, tmp_path, capsys):
    arguments = ["report", str(out), "--html", str(tmp_path / "x.html"), "--survey", str(tmp_path / "s")]
    assert main(arguments) == 0
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("wrote ") == 3
    assert (tmp_path / "x.html").read_text().startswith("<!DOCTYPE html>")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "Missing argument 'DIR...'"),
        (["{none}"], "there is no such folder"),
        (["{empty}"], "no metrics.json under"),
        (["{out}", "--anchor", "nobody"], "--anchor nobody: no run is of it; there are 3dgs, toy"),
        (["{out}", "--html", "{empty}"], "is a folder: give the name of a file in it"),
        (["{out}", "--html", "{none}/x.html"], "there is no folder"),
        (["{out}", "--survey", "{file}"], "it is a file, not a folder"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(out, tmp_path, capsys, arguments, complaint):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    places = {"none": tmp_path / "none", "empty": tmp_path / "empty", "out": out, "file": tmp_path / "file"}
    assert main(["report", *(a.format(**places) for a in arguments)]) == 2
    printed = capsys.readouterr()
    assert complaint in printed.err
    assert len(printed.err.strip().splitlines()) <= 2
    assert printed.out == ""
    assert list((tmp_path / "empty").iterdir()) == []

"""Curves for papers: every method with its colour, in files that are equal for equal runs."""

import builtins
from xml.etree import ElementTree

import pytest
from sw_report.charts import STYLES
from sw_report.figures import Line, Panel, write_figures, write_panels
from sw_report.method_styles import style_of_method
from sw_report.rd_file import themes
from sw_report.runs import collect

from splatwizard_core.cli.main import main
from splatwizard_core.errors import UserInputError


def without_ssim(content):
    del content["metrics"]["ssim"]  # one panel is drawn in half the time


@pytest.fixture
def runs(make_curve, tmp_path):
    pytest.importorskip("matplotlib")
    for scene in ("garden", "a $cene"):
        make_curve("toy_$x", scene=scene, change=without_ssim)
        make_curve("3dgs", 0.5, scene=scene, change=without_ssim)
    return collect([tmp_path / "out"]).runs


def test_scenes_and_data_sets_are_svg_and_pdf_with_the_colours_of_the_page(runs, tmp_path):
    files = write_figures(runs, tmp_path / "plots")
    assert [file.name for file in files] == [
        "rd-a_cene.svg", "rd-a_cene.pdf", "rd-garden.svg", "rd-garden.pdf",
        "rd-colmap.svg", "rd-colmap.pdf",
    ]  # fmt: skip
    for file in files:
        if file.suffix == ".pdf":
            assert file.read_bytes().startswith(b"%PDF-")
            continue
        text = file.read_text()
        assert "".join(ElementTree.fromstring(text).itertext()).count("toy_$x") == 1  # the legend, not mathematics
        for method in ("toy_$x", "3dgs"):
            assert themes()[0][f"--s{style_of_method(method) % STYLES}"] in text
        assert "PSNR dB" in text
    garden = [run for run in runs if run.facts.scene == "garden"]
    for again in write_figures(garden, tmp_path / "again"):  # equal runs make equal files
        assert again.read_bytes() == (tmp_path / "plots" / again.name).read_bytes()


def test_the_command_writes_them_where_asked_and_none_over_another(make_run, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    make_run(change=without_ssim)
    make_run(out=tmp_path / "out" / "more", change=lambda c: (without_ssim(c), c["protocol"].update(id="other")))
    assert main(["report", str(tmp_path / "out"), "--plots", str(tmp_path / "plots")]) == 0
    printed = capsys.readouterr()
    assert (printed.out, printed.err.count("wrote ")) == ("", 4)
    assert {file.name for file in (tmp_path / "plots").glob("*.svg")} == {"rd-garden.svg", "rd-garden@2.svg"}


def test_sizes_are_read_at_1_2_and_5(tmp_path):
    pytest.importorskip("matplotlib")
    line = Line("3dgs", [(0.25, 30.0, None), (6.0, 31.0, None)], 0)
    text = write_panels([Panel("x", [line])], tmp_path / "x.svg").read_text("utf-8")
    written = [label for label in ElementTree.fromstring(text).itertext() if label.strip()]
    assert written[: written.index("file size, MB")][-4:] == ["0.5", "1", "2", "5"]


def test_without_matplotlib_one_line_says_what_to_install(make_run, tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name.partition(".")[0] == "matplotlib":
            raise ImportError(name)
        return real(name, *rest)

    make_run()
    runs = collect([tmp_path]).runs
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UserInputError, match=r"--plots needs matplotlib: pip install 'sw-report\[plots\]'"):
        write_figures(runs, tmp_path / "plots")

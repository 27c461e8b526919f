"""`sw compare --published`: figures have a source, and what differs from a run is named."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from click.testing import CliRunner
from sw_report.compare import compare
from sw_report.equal_psnr import CurvePoint, at_equal, overlap
from sw_report.published import beside, differences, steps_of
from sw_report.published_files import Figure, published_by, read_figures, read_published
from sw_report.published_tables import deltas, published_tables
from sw_report.runs import collect

from splatwizard_core.api import UserInputError

PROTOCOL = {"id": "mipnerf360/x", "dataset": "mipnerf360", "images": "images", "resolution": -1, "split": "every8",
            "background": "black"}  # fmt: skip
STEPS = {"train_s": 1.0, "steps": 30_000, "pretraining": {}}


def written(folder: Path, scenes=("bonsai",), **changes) -> list:
    """Runs of hac r1 on scenes of Mip-NeRF 360, as they are collected."""
    for scene in scenes:
        record = {
            "method": "hac", "rate": "r1", "dataset": "mipnerf360", "scene": scene, "protocol": PROTOCOL,
            "train": STEPS, "file": {"bytes": 8_000_000},
            "metrics": {"psnr": {"mean": 32.0}, "ssim": {"mean": 0.94}, "lpips_vgg_3dgs": {"mean": 0.19}},
            "counts": {"num_gaussians": 1_000_000}, "schema_version": 1, **changes,
        }  # fmt: skip
        place = folder / scene / "hac" / str(record["rate"])
        place.mkdir(parents=True)
        (place / "metrics.json").write_text(json.dumps(record))
    return collect([folder]).runs


@pytest.fixture
def runs(tmp_path):
    return lambda **changes: written(tmp_path / "out", **changes)


def test_a_run_as_published_differs_in_what_nobody_can_change_alone(runs):
    (run,) = runs()
    (found,) = beside(run.facts, "bonsai", read_published())
    assert found.same_rate
    assert found.figure.bytes == 8_976_754
    assert found.differences == tuple(found.figure.differs)
    psnr, size = deltas({"psnr": 32.0, "bytes": 8_976_754 / 2}, found.figure)
    assert psnr == pytest.approx(32.0 - 32.275)
    assert size == pytest.approx(-50)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"protocol": {**PROTOCOL, "images": "images_2"}}, "images images_2 here, images there"),
        ({"protocol": {**PROTOCOL, "background": "white"}}, "background white here, black there"),
        ({"train": {**STEPS, "steps": 7000}}, "7,000 steps here, 30,000 there"),
        ({"metrics": {"psnr": {"mean": 30.0}, "ssim": {"mean": 0.9}}}, "no LPIPS here"),
    ],
)
def test_what_differs_is_named(runs, changes, told):
    (run,) = runs(**changes)
    (found,) = beside(run.facts, "bonsai", read_published())
    assert told in found.differences


@pytest.mark.parametrize("split", ["sparse:9", "sector:60@120", "block:0of4", "file+sector:90@40"])
def test_nothing_published_stands_beside_a_split_that_holds_out_places(runs, split):
    (run,) = runs(protocol={**PROTOCOL, "split": split})
    assert beside(run.facts, "bonsai", read_published()) == []


def test_steps_count_those_of_the_scene_that_a_training_started_from(runs):
    (run,) = runs(train={**STEPS, "steps": 5000, "pretraining": {"3dgs": {"steps": 30_000}}})
    assert steps_of(run.facts) == 35_000
    (run,) = collect([run.directory]).runs
    (figure,) = read_figures(TABLE.format(more='protocol = "360-unstated"\nsteps = 35000'), "theirs", "c3dgs")
    assert not any("steps" in line for line in differences(run.facts, figure))
    assert "pictures not stated there" in differences(run.facts, figure)


def test_values_that_the_published_run_had_are_compared(runs):
    config = {"method": "hac", "config": {"growth": {"init_factor": 16}}, "scene": {"background": "white"}}
    protocol = {**PROTOCOL, "dataset": "nerf_synthetic", "split": "file", "background": "black"}
    (run,) = runs(scenes=("lego",), dataset="nerf_synthetic", config=config, protocol=protocol)
    (found,) = beside(run.facts, "lego", read_published())
    assert "growth.init_factor 16 here, 4 there" in found.differences
    assert not any(line.startswith("background") for line in found.differences), "the protocol says it"


def test_another_rate_point_stands_beside_all_of_the_method(runs):
    (run,) = runs(rate="r3")
    found = beside(run.facts, "bonsai", read_published())
    assert [each.figure.rate for each in found] == ["r1", "r5"]
    assert not any(each.same_rate for each in found)
    assert "rate point r3 here, r1 there" in found[0].differences


def test_means_are_compared_once_every_scene_is_there(runs, tmp_path):
    scenes = ("bicycle", "flowers", "garden", "stump", "treehill", "room", "counter", "kitchen", "bonsai")
    some = published_tables(written(tmp_path / "some", scenes[:8]))
    assert not any(table.title.startswith("mean") for table in some)
    mean = published_tables(written(tmp_path / "all", scenes))[-1]
    assert mean.title == "mean over Mip-NeRF 360, 9 scenes"
    ((_, (found,)),) = mean.groups
    assert found.figure.bytes == 16_005_406
    assert {"hemgs", "contextgs"} <= {figure.method for figure in mean.others}
    assert {figure.method for figure in mean.left_out} == {"bogauss"}
    assert "left out, since its protocol is not that of the others: bogauss, tiny" in "\n".join(mean.drawn().notes)


def test_the_command_prints_both_and_names_scenes_without_figures(runs, tmp_path):
    runs()
    done = CliRunner().invoke(compare, [str(tmp_path / "out"), "--published"])
    assert done.exit_code == 0, done.output
    assert "hac r1" in done.output
    assert "32.27" in done.output or "32.28" in done.output
    assert "results/MipNeRF360/bonsai.csv" in done.output
    assert "contextgs" in done.output
    done = CliRunner().invoke(compare, [str(tmp_path / "out"), "--published", "--own", "--json"])
    content = json.loads(done.output)
    assert content["tables"][0]["others"] == []
    assert content["tables"][0]["runs"][0]["published"][0]["year"] == 2024
    with pytest.raises(UserInputError, match=r"nothing is published for demo/demo: .*mipnerf360"):
        published_tables(written(tmp_path / "demo", ("demo",), dataset="demo"))


def test_bytes_at_equal_psnr_are_those_of_the_rate_points_around(tmp_path):
    sizes = {"r1": (31.275, 4_937_215), "r5": (33.275, 19_748_859)}  # 1.1 of half and of twice the published bytes
    for rate, (psnr, size) in sizes.items():
        written(tmp_path / "out", rate=rate, file={"bytes": size}, metrics={"psnr": {"mean": psnr}})
    (table,) = published_tables(collect([tmp_path / "out"]).runs, others=False)
    low = table.groups[0][0]
    found = at_equal(low.curve, 32.275, 8_976_754)
    assert found.ratio == pytest.approx(1.1)  # half way in dB, and in the logarithm of bytes
    assert found.gain == pytest.approx(-math.log(1.1, 4) * 2, abs=1e-6)
    (line, *_) = [line for line in table.drawn().rows if "[1]" in line.cells[0].text]
    assert [cell.text for cell in line.cells[-2:]] == ["−45.0 %", "+10.0 %"]


def test_one_rate_point_makes_no_curve_and_that_is_said(runs):
    (run,) = runs()
    (table,) = published_tables([run], others=False)
    assert any("no bytes at equal PSNR: 1 rate point measured here" in note for note in table.drawn().notes)


CURVE = [CurvePoint("r1", 1e6, 30.0), CurvePoint("r2", 2e6, 32.0), CurvePoint("r3", 4e6, 33.0)]


@pytest.mark.parametrize(
    ("psnr", "size", "ratio", "gain", "why"),
    [
        (31.0, 2e6, 2**-0.5, 1.0, ""),
        (32.5, 2e6, 2**0.5, -0.5, ""),
        (33.4, 4e6, None, -0.4, "0.40 dB above what is measured here"),
        (29.9, 8e6, None, None, "0.10 dB below what is measured here"),
        (None, 2e6, None, None, "no PSNR is published"),
        (31.0, None, None, None, ""),
    ],
)
def test_a_published_point_against_a_curve(psnr, size, ratio, gain, why):
    found = at_equal(CURVE, psnr, size)
    assert found.ratio == (None if ratio is None else pytest.approx(ratio))
    assert found.gain == (None if gain is None else pytest.approx(gain))
    assert found.why == why


def test_a_point_that_a_smaller_file_beats_bends_no_curve():
    worse = CurvePoint("r4", 5e6, 31.0)
    assert at_equal([*CURVE, worse], 32.5, 2e6) == at_equal(CURVE, 32.5, 2e6)


def test_the_overlap_is_a_share_of_the_wider_range():
    assert overlap(CURVE, [31.0, 35.0]) == pytest.approx(2 / 4)
    assert overlap(CURVE, [34.0, 35.0]) == 0.0
    assert overlap(CURVE, [34.0]) is None


TABLE = """
[[tables]]
dataset = "mipnerf360"
source = "a paper, {{scene}}.csv"
year = 2024
verified = true
{more}
figures = [{{ scene = "room", rate = "r1", psnr = 30.0 }}]
"""


def test_a_file_of_figures_is_read_with_its_own_protocols():
    more = 'protocol = "mine"'
    own = '\n[protocols.mine]\ntext = "as we like it"\nrules = { background = "grey" }\n'
    (figure,) = read_figures(TABLE.format(more=more) + own, "theirs", "theirs")
    assert figure.protocol.rules == {"background": "grey"}
    assert (figure.method, figure.source, figure.rate, figure.bytes) == ("theirs", "a paper, room.csv", "r1", None)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (TABLE.format(more='protocol = "none"'), r"theirs: table 1, figure 1: no protocol is called 'none'"),
        (TABLE.format(more='protocol = "survey"\npsnrr = 3'), r"table 1, figure 1: psnrr: Extra"),
        (TABLE.format(more='protocol = "survey"\nmethod = "hac"'), r"leave out 'method': the file is of 'mine'"),
        (TABLE.format(more='protocol = "survey"').replace("30.0", "-1"), r"figure 1: psnr: Input should be greater"),
        (
            TABLE.format(more='protocol = "survey"').replace("verified = true", ""),
            r"figure 1: verified: Field required",
        ),
        ("tables = 3", r"theirs: tables must be a list of tables"),
        ("figures = []", r"theirs: unknown key 'figures'"),
        ("[[tables", r"theirs is not valid TOML"),
        ("[protocols.x]\nrules = 3", r"theirs: protocol x: "),
    ],
)
def test_what_is_wrong_in_a_file_of_figures_is_named(text, told):
    with pytest.raises(UserInputError, match=told):
        read_figures(text, "theirs", "mine")


BROKEN = {
    "missing": ("", None), "damaged": ("", b"[[tables"), "binary": ("", b"\xff\xfe"),
    "exits": ("raise SystemExit('no')", b""), "raises": ("raise RuntimeError('no')", b""),
}  # fmt: skip


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_file_is_left_out_with_one_line_that_names_its_distribution(
    fault, installed, tmp_path, monkeypatch, caplog
):
    code, content = BROKEN[fault]
    package = tmp_path / f"figures_{fault}"
    package.mkdir()
    (package / "__init__.py").write_text(code)
    if content is not None:
        (package / "published.toml").write_bytes(content)
    monkeypatch.syspath_prepend(str(tmp_path))
    registry = installed.methods
    registry._owner = ("sw-theirs", "0.2", True)
    registry.add("theirs", "nowhere:method", summary="", published=f"{package.name}:published.toml")
    figures = read_published()
    assert {"hac", "contextgs"} <= {figure.method for figure in figures}
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("sw-theirs 0.2: published figures of 'theirs' are left out: ")
    assert "\n" not in line


@pytest.mark.parametrize("value", ["published.toml", "a:b.json", "a:../b.toml", 3, ["a:b.toml"]])
def test_an_entry_that_declares_figures_in_another_way_is_refused(value, installed):
    installed.methods.add("theirs", "nowhere:method", summary="", published=value)
    assert "theirs" not in installed.methods
    assert "it must be 'package:file.toml'" in installed.methods.refused[-1][1]


def test_a_method_that_is_installed_brings_its_figures_itself(installed, tmp_path, monkeypatch):
    package = tmp_path / "figures_of_contextgs"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "published.toml").write_text(TABLE.format(more='protocol = "survey"'))
    monkeypatch.syspath_prepend(str(tmp_path))
    installed.methods.add("contextgs", "nowhere:method", summary="", published=f"{package.name}:published.toml")
    (figure,) = published_by(installed.methods.entry("contextgs"))
    assert isinstance(figure, Figure)
    assert [each for each in read_published() if each.method == "contextgs"] == [figure]

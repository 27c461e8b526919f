"""A small scene to a size and to a quality, by the library and the command."""

import contextlib
import errno
import json
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner
from sw_compress import Compressed, compress, compressing
from sw_compress.command import compress as command
from sw_compress.command import default_output
from sw_compress.stages import Stages

from splatwizard_core.api import UserInputError
from splatwizard_core.cli.main import main
from splatwizard_core.tooling import ForeseenError, export_model, load_plugins, open_model, read_gaussians

pytestmark = pytest.mark.pipeline
FULL_DISK = OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture(scope="module")
def source(tmp_path_factory, ball) -> Path:
    path = tmp_path_factory.mktemp("source") / "ball.ply"
    export_model(ball(400), path, load_plugins())
    return path


@pytest.fixture(scope="module")
def small(source, tmp_path_factory) -> Compressed:
    return compress(source, size=7_000, views=6, device="cpu", out=tmp_path_factory.mktemp("out") / "small.swz")


def test_the_size_is_met_and_never_exceeded(small):
    assert 0.99 * 7_000 < small.out.stat().st_size <= 7_000
    assert small.record["bytes"] == small.out.stat().st_size == sum(small.record["sections"].values())
    assert small.record["encodes"] <= 4


def test_the_file_opens_as_any_other(small):
    model, reader = open_model(small.out, load_plugins(), torch.device("cpu"))
    gone = sum(small.record[name] for name in ("left_out", "pruned", "merged"))
    assert model.num_rows == small.record["gaussians"] == 400 - gone
    assert torch.equal(model.means, small.model.means)
    assert reader.method == "3dgs"


def test_the_record_holds_what_was_done(small):
    record = json.loads(json.dumps(small.record))
    assert record["quality"]["views"] == len(record["cameras"]["held_out"]) == 1
    assert record["cameras"]["recipe"] == "plausible"
    assert set(record["seconds"]) >= {"read", "cameras", "sensitivities", "search", "encode", "check", "total"}
    assert record["quality"]["psnr"] > 25
    assert record["told"].endswith("dB of photographs that the source meets at 27 / 32 / 36 dB")
    assert record["loss_of_photographs"]["27"] < record["loss_of_photographs"]["36"]
    held_out = {json.dumps(each) for each in record["cameras"]["held_out"]}
    assert not held_out & {json.dumps(each) for part in ("fit", "judge") for each in record["cameras"][part]}


def test_equal_calls_give_equal_bytes(source, small):
    again = compress(source, size=7_000, views=6, device="cpu")
    assert again.out is None
    assert again.data == small.out.read_bytes()


def test_a_larger_size_is_a_better_picture(source, small):
    large = compress(source, size="12kB", views=6, device="cpu")
    assert large.record["quality"]["psnr"] > small.record["quality"]["psnr"]


def test_a_quality_is_reached_and_little_exceeded(source):
    done = compress(source, quality="45dB", views=6, device="cpu")
    assert 45 <= done.record["quality"]["psnr"] <= 45.2


def test_the_size_of_a_tiny_scene_is_met_too(ball):
    done = compress(ball(30), size=2_000, views=6, device="cpu")
    assert 0.99 * 2_000 < done.record["bytes"] <= 2_000


def test_a_size_out_of_reach_names_one_that_is_not(ball, tmp_path):
    model = ball(30)
    with pytest.raises(UserInputError) as error:
        compress(model, size=900, views=6, device="cpu", out=tmp_path / "a.swz")
    assert list(tmp_path.iterdir()) == []
    smallest = int(re.search(r"smallest has ([0-9,]+) bytes", str(error.value))[1].replace(",", ""))
    assert compress(model, size=smallest, views=6, device="cpu").record["bytes"] <= smallest


def test_a_number_of_gaussians_keeps_the_most_significant(ball):
    """Gaussians that no camera shows go first."""
    model = ball(60, degree=0)
    model.opacity_logits[:20] = -5.4  # drawn, and never more than a 1/255 of a pixel
    model.means[7], model.log_scales[7], model.opacity_logits[7] = torch.zeros(3), torch.full((3,), -0.7), 4.0
    done = compress(model, gaussians=1, size=1_200, views=6, device="cpu")
    assert done.model.num_rows == 1
    assert torch.allclose(done.model.means, torch.zeros(1, 3), atol=0.1)


def test_more_than_the_finest_settings_give_is_told(source):
    lines: list[str] = []
    done = compress(source, size="1MB", views=6, device="cpu", say=lines.append)
    assert done.record["bytes"] < 990_000
    assert any("finest settings" in line for line in lines)


@pytest.mark.parametrize(("stage", "stop"), [("encode", FULL_DISK), ("decode", KeyboardInterrupt())])
def test_an_interruption_and_a_full_disk_leave_nothing(ball, tmp_path, monkeypatch, stage: str, stop: BaseException):
    out, timed = tmp_path / "a.swz", Stages.timed
    out.write_bytes(b"an older file")

    @contextlib.contextmanager
    def stopped(stages: Stages, name: str) -> Iterator[None]:
        with timed(stages, name):
            yield
            if name == stage:
                raise stop

    monkeypatch.setattr(Stages, "timed", stopped)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises((KeyboardInterrupt, ForeseenError)):
        compress(ball(60), size="2kB", views=6, device="cpu", out=out, drop_unseen=True)
    assert [path.name for path in tmp_path.iterdir()] == ["a.swz"]
    assert out.read_bytes() == b"an older file"


def test_another_format_meets_the_size(source, tmp_path):
    out = tmp_path / "a.sog"
    done = compress(source, size="14kB", views=6, device="cpu", format="sog", out=out, drop_unseen=True)
    assert out.stat().st_size <= 14_000
    assert done.record["bytes"] == out.stat().st_size
    assert read_gaussians(out, load_plugins()).num_rows == done.record["gaussians"]


def test_what_asks_for_antialiasing_still_does(tmp_path, ball):
    model = ball(150)
    model.origin = {"raster": {"antialias": True}}
    done = compress(model, size="4kB", views=6, device="cpu", out=tmp_path / "a.swz")
    assert done.record["antialiased"]
    _, reader = open_model(tmp_path / "a.swz", load_plugins(), torch.device("cpu"))
    assert reader.raster["antialias"] is True


def test_the_number_and_the_degree_may_be_given(source):
    done = compress(source, size="5kB", views=6, device="cpu", gaussians=250, sh_degree=0, drop_unseen=True)
    assert (done.record["gaussians"], done.record["sh_degree"]) == (250, 0)


def test_a_refined_file_has_its_size_and_is_no_worse(ball):
    done = compress(ball(200), size="2500", views=9, device="cpu", refine=0.3)
    assert 0.99 * 2_500 < done.record["bytes"] <= 2_500
    told = done.record["refined"]
    assert told["steps"] > 0
    assert told["psnr_after"] >= told["psnr_before"]
    assert done.record["seconds"]["refine"] >= 0.3


def test_several_files_of_which_some_fail(source, tmp_path):
    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    options = ["--size", "5kB", "--views", "6", "--device", "cpu", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(command, [str(tmp_path / "no.ply"), str(broken), str(source), *options])
    assert done.exit_code == 1
    assert "broken.ply" in done.output
    assert "no.ply: there is no such file" in done.output
    assert "2 of 3 files failed" in done.output
    assert (tmp_path / "out" / "ball.swz").stat().st_size <= 5_000
    assert "smaller than ball.ply" in done.output


def test_a_folder_is_made_for_a_file_alone(source, tmp_path):
    out = tmp_path / "new" / "out"
    files = [str(source), str(tmp_path / "no.ply"), "--device", "cpu", "--views", "6", "--out", str(out)]
    done = CliRunner().invoke(command, [*files, "--size", "100"])
    assert done.exit_code == 1
    assert list(tmp_path.iterdir()) == []


def test_a_source_is_never_replaced(small):
    done = CliRunner().invoke(command, [str(small.out), "--out", str(small.out)])
    assert isinstance(done.exception, UserInputError)
    assert "would be replaced" in str(done.exception)


@pytest.mark.parametrize(
    ("name", "options", "told"),
    [
        ("no.ply", [], "no.ply: there is no such file"),
        ("a.txt", [], r"a.txt: of none of the formats that are read, .*\.ply, .*\.swz"),
        ("a.ply", [], "a.ply: not a .ply file"),
        ("empty.ply", [], "empty.ply: not a .ply file"),
        ("cut.ply", [], r"cut.ply: not a whole .ply file: its header has no end .truncated"),
        ("folder", [], "folder is a folder, and this command takes a file"),
        ("ball.ply", ["--size", "0"], "'0' is no size: give bytes"),
        ("ball.ply", ["--size", "1e400MB"], "'1e400MB' is no size: .*8MB"),
        ("ball.ply", ["--quality", "200dB"], "quality '200dB' must be a number in 15 .. 70"),
        ("ball.ply", ["--ratio", "0.5"], "ratio '0.5' must be a number in 1 .."),
        ("ball.ply", ["--size", "5kB", "--ratio", "2"], "give one of them"),
        ("ball.ply", ["--size", "400"], "no file of 400 bytes was found: the smallest has about"),
        ("ball.ply", ["b.ply", "--out", "one.swz"], "--out one.swz names one file, and there are 2 .*: name a folder"),
        ("ball.ply", ["--out", "no/such/a.swz"], "there is no folder no/such"),
        ("ball.ply", ["--out", "folder"], "folder is a folder: give the name of a file in it"),
        ("ball.ply", ["--out", "a.zip"], "a.zip: a file of this name would hold swz, .*: give --out FILE.swz"),
        ("ball.ply", ["--out", "b.swz", "--format", "spz"], "b.swz: a file of this name would hold spz"),
        ("ball.ply", ["--refine", "5", "--format", "spz"], "only .swz files are refined, not .spz"),
        ("ball.ply", ["--cameras", "a.txt"], "a.txt: not a JSON file of cameras"),
    ],
)
def test_what_is_wrong_is_told_in_a_line_and_nothing_is_written(
    source, tmp_path, monkeypatch, capsys, name: str, options: list[str], told: str
):
    (tmp_path / "folder").mkdir()
    for other, text in (("a.txt", "hi"), ("a.ply", "hi"), ("cut.ply", "ply\nformat"), ("empty.ply", "")):
        (tmp_path / other).write_text(text)
    (tmp_path / "ball.ply").write_bytes(source.read_bytes())
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    assert main(["compress", name, "--device", "cpu", *options]) == 2
    printed = capsys.readouterr().err.strip()
    assert re.search(told, printed)
    assert len(printed.splitlines()) <= 2
    assert sorted(tmp_path.rglob("*")) == before


def test_the_name_of_the_result_chooses_the_format_and_an_older_file_is_replaced(source, tmp_path):
    out = tmp_path / "a.spz"
    out.write_bytes(b"an older file")
    options = ["--size", "14kB", "--views", "6", "--device", "cpu", "--out", str(out)]
    done = CliRunner().invoke(command, [str(source), *options])
    assert done.exit_code == 0, done.output
    assert out.stat().st_size <= 14_000
    assert read_gaussians(out, load_plugins()).num_rows > 100


def test_a_size_out_of_reach_is_told_before_anything_is_drawn(source, monkeypatch):
    monkeypatch.setattr(compressing, "made_up_views", lambda *_: pytest.fail("cameras were made up"))
    with pytest.raises(UserInputError, match="smallest"):
        compress(source, size=400, device="cpu")


@pytest.mark.parametrize("name", ["lod-meta.json", "meta.json"])
def test_what_comes_of_a_folder_with_an_index_lies_beside_it(tmp_path, name: str):
    assert default_output(tmp_path / "garden" / name, ".swz") == (tmp_path / "garden.swz").resolve()
    assert default_output(tmp_path / "other.json", ".swz") == tmp_path / "other.swz"

"""Streamed SOG that is written here holds every Gaussian of every level once, in boxes that hold it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import cKDTree
from sw_interchange import from_gaussians, read
from sw_interchange.streamed_sog import parse_index
from sw_lod import write_lod
from sw_lod.command import lod
from sw_lod.streamed import write_streamed
from sw_lod.tree import build_tree, leaves_of

from splatwizard_core.api import UserInputError
from splatwizard_core.cli.main import main


@pytest.fixture(scope="module")
def written(model, tmp_path_factory) -> tuple[Path, dict]:
    index = tmp_path_factory.mktemp("lod") / "scene" / "lod-meta.json"
    return index, write_lod(model, index, levels=3, chunk=400, device="cpu")


def test_each_level_has_half_of_the_one_before(written):
    index, record = written
    found = parse_index(index.read_bytes(), "index")
    assert record["counts"] == found.counts == [1200, 600, 300]
    assert [read(index, level=level).num_gaussians for level in range(3)] == found.counts


def test_the_finest_level_is_the_scene(written, model):
    scene, found = from_gaussians(model), read(written[0])
    far, rows = cKDTree(found.means).query(scene.means)
    assert len(set(rows.tolist())) == scene.num_gaussians
    assert far.max() < 1e-3  # steps of 16 bits over a scene of 8 units
    assert np.abs(found.sh_dc[rows] - scene.sh_dc).max() < 0.1  # a codebook of 256 for each unit


def test_a_place_names_rows_whose_gaussians_lie_in_its_box(written):
    index, _ = written
    found = parse_index(index.read_bytes(), "index")
    units = {name: read(index.parent / name) for name in found.units}
    for leaf in found.leaves:
        assert sum(rows.count for rows in leaf.levels.values()) <= 400
        for rows in leaf.levels.values():
            means = units[found.units[rows.file]].means[rows.offset : rows.offset + rows.count]
            assert (means >= np.array(leaf.low) - 1e-3).all()
            assert (means <= np.array(leaf.high) + 1e-3).all()


def test_the_box_of_a_parent_holds_those_of_its_children(written):
    pending = [json.loads(written[0].read_text())["tree"]]
    while pending:
        node = pending.pop()
        for child in node.get("children", []):
            assert np.all(np.array(child["bound"]["min"]) >= node["bound"]["min"])
            assert np.all(np.array(child["bound"]["max"]) <= node["bound"]["max"])
            pending.append(child)


def leaves_told(node: dict) -> list[dict]:
    return [leaf for child in node["children"] for leaf in leaves_told(child)] if "children" in node else [node]


def test_each_place_tells_the_errors_of_its_levels(written):
    found = json.loads(written[0].read_text())
    assert found["lodErrors"] is True
    errors = np.array([leaf["errors"] for leaf in leaves_told(found["tree"])])
    assert errors.shape[1] == 3
    assert not errors[:, 0].any()
    assert (np.diff(errors, axis=1) >= 0).all()
    assert 1e-4 < np.median(errors[:, 1]) < np.median(errors[:, 2]) < 1


def test_errors_of_a_place_are_shares_of_its_own_picture(model, tmp_path):
    scene = from_gaussians(model)
    along = scene.means[:, np.ptp(scene.means, axis=0).argmax()]  # places are halved across their longest side
    left = along < np.median(along)
    levels = [scene, scene]
    shares = [np.ones(1200), np.where(left, 0.5, 0.0)]
    write_streamed(levels, tmp_path / "lod-meta.json", chunk=1200, shares=shares, iterations=1)
    found = [leaf["errors"] for leaf in leaves_told(json.loads((tmp_path / "lod-meta.json").read_text())["tree"])]
    assert np.array(found) == pytest.approx(np.array([[0, 0.5], [0, 0]]), abs=1e-3)


def test_a_scene_that_no_picture_shows_has_no_errors(model, tmp_path):
    scene = from_gaussians(model)
    write_streamed([scene], tmp_path / "lod-meta.json", chunk=1200, shares=[np.zeros(1200)], iterations=1)
    assert '"errors"' not in (tmp_path / "lod-meta.json").read_text()


def test_a_unit_holds_one_level_and_is_closed_when_it_is_full(written):
    index, record = written
    found = parse_index(index.read_bytes(), "index")
    for number in range(len(found.units)):
        used = [(level, rows) for leaf in found.leaves for level, rows in leaf.levels.items() if rows.file == number]
        assert len({level for level, _ in used}) == 1
        assert sum(rows.count for _, rows in used[:-1]) <= 400
    assert record["units"] == len(found.units) > 3


def test_the_same_scene_gives_the_same_files(written, model, tmp_path):
    write_lod(model, tmp_path / "lod-meta.json", levels=3, chunk=400, device="cpu")
    for file in sorted(written[0].parent.rglob("*.*")):
        assert (tmp_path / file.relative_to(written[0].parent)).read_bytes() == file.read_bytes()


def test_gaussians_at_one_place_are_one_leaf(model):
    scene = replace(from_gaussians(model), means=np.ones((1200, 3), np.float32))
    assert len(leaves_of(build_tree([scene], 300))) == 1


def test_what_cannot_be_seen_is_left_out(model, tmp_path):
    import torch

    raw = {name: getattr(model, name).detach().clone() for name in model.RAW}
    raw["opacity_logits"][:7] = -20
    raw["means"][7] = torch.nan
    record = write_lod(type(model)(**raw), tmp_path / "lod-meta.json", levels=1, device="cpu")
    assert record["counts"] == [1192]


@pytest.mark.parametrize(("out", "told"), [("scene.json", "lod-meta.json"), ("scene.sog", "lod-meta.json")])
def test_other_names_are_refused(model, tmp_path, out, told):
    with pytest.raises(UserInputError, match=told):
        write_lod(model, tmp_path / out)


@pytest.mark.parametrize("name", ["lod-meta.json", "scene.swz"])
def test_the_file_that_is_read_is_not_replaced(tmp_path, name):
    file = tmp_path / name
    file.write_bytes(b"source")
    with pytest.raises(UserInputError, match="the file that is read"):
        write_lod(file, file)
    assert file.read_bytes() == b"source"


@pytest.mark.parametrize("chunk", ["0", "-1", "8 mb", "1e9", "99999999999k", "10"])
def test_a_size_of_pieces_that_makes_no_sense_is_refused(tmp_path, chunk):
    file = tmp_path / "scene.ply"
    file.write_bytes(b"ply\n")
    found = CliRunner().invoke(lod, [str(file), "--out", str(tmp_path / "lod-meta.json"), "--chunk", chunk])
    assert found.exit_code != 0
    assert not (tmp_path / "lod-meta.json").exists()


def test_the_command_counts_in_words_and_sw_info_reads_the_folder(written, tmp_path, capsys):
    source, folder = written[0].parent, tmp_path / "new"
    assert main(["lod", str(source / "lod-meta.json"), "--out", str(folder / "lod-meta.json"), "--levels", "1"]) == 0
    assert "1 level (1,200 Gaussians) in 1 piece, 1 unit of" in capsys.readouterr().out
    assert main(["info", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["num_gaussians"] == 1200
    assert main(["export", str(folder), str(tmp_path / "x.ply")]) == 2
    assert f"the file in it is {folder / 'lod-meta.json'}" in capsys.readouterr().err
    (folder / "lod-meta.json").write_text('{"version":1,')
    assert main(["info", str(folder)]) != 0
    assert "lod-meta.json: a damaged index" in capsys.readouterr().err


def test_units_of_a_scene_that_was_there_before_go_and_nothing_else(model, tmp_path):
    index, said = tmp_path / "lod-meta.json", []
    write_lod(model, index, levels=3, chunk=400, device="cpu")
    (tmp_path / "1_0" / "notes.txt").write_text("mine")
    (tmp_path / "9_9").mkdir()
    write_lod(model, index, device="cpu", say=said.append)
    kept = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.glob("[1-9]_*/*"))
    assert kept == ["1_0/notes.txt"]
    assert (tmp_path / "9_9").is_dir()
    assert not (tmp_path / "2_0").exists()
    assert "2_0: of the scene that was here before, removed" in said
    assert "1,200 Gaussians are few: there is one level; --levels makes more" in said


@pytest.mark.parametrize(
    "told", ['{"asset":{"generator":"other"},"filenames":["1_0/meta.json"]}', '{"asset":', "[]", '{"filenames":3}']
)
def test_what_an_index_of_others_names_stays(model, tmp_path, told):
    (tmp_path / "1_0").mkdir()
    (tmp_path / "1_0" / "meta.json").write_text("theirs")
    (tmp_path / "lod-meta.json").write_text(told)
    write_lod(model, tmp_path / "lod-meta.json", levels=1, device="cpu")
    assert (tmp_path / "1_0" / "meta.json").read_text() == "theirs"


def test_an_interrupt_leaves_no_folder(model, tmp_path):
    def interrupt(line: str) -> None:
        if line.startswith("0_0"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_lod(model, tmp_path / "new" / "lod-meta.json", levels=2, chunk=400, device="cpu", say=interrupt)
    assert not (tmp_path / "new").exists()

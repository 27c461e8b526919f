"""Streamed SOG: levels are read as scenes, and whatever an index claims is held against what else it says."""

import copy
import json
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from interchange_files import random_scene
from refusals import refusal
from sw_interchange import GaussianScene, Limits, read, write
from sw_interchange.streamed_sog import MAX_INDEX

from splatwizard_core.api import BitstreamError, UserInputError

MEMORY = 256 << 20
LINES = 100_000  # of Python; none needs a tenth
BOUND = {"min": [-9.0] * 3, "max": [9.0] * 3}


def place(folder: Path) -> dict:
    """Two units and an environment on disk, and the index of two leaves with two levels."""
    for name, count, degree in (("0_0", 40, 1), ("1_0", 20, 0), ("env", 4, 0)):
        (folder / name).mkdir()
        write(random_scene(count, degree), folder / name / "meta.json", iterations=1)

    def leaf(*rows: tuple[int, int, int]) -> dict:
        lods = {str(k): dict(zip(("file", "offset", "count"), of, strict=True)) for k, of in enumerate(rows)}
        return {"bound": BOUND, "lods": lods}

    leaves = [leaf((0, 0, 25), (1, 5, 15)), leaf((0, 25, 15), (1, 0, 5))]
    return {
        "version": 1, "count": 60, "counts": [40, 20], "lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"],
        "tree": {"bound": BOUND, "children": leaves},
    }  # fmt: skip


@pytest.fixture(scope="module")
def streamed(tmp_path_factory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("streamed")
    return folder, place(folder)


def read_index(folder: Path, index: dict | str, **options) -> GaussianScene:
    path = folder / "lod-meta.json"
    path.write_text(index if isinstance(index, str) else json.dumps(index))
    return read(path, **options)


def test_a_level_is_the_rows_that_its_leaves_name(streamed):
    folder, index = streamed
    fine, coarse = read_index(folder, index), read_index(folder, index, level=1)
    assert fine.report.format == "streamed-sog"
    assert np.array_equal(fine.means, read(folder / "0_0").means)
    unit = read(folder / "1_0").means
    assert np.array_equal(coarse.means, np.concatenate([unit[5:20], unit[:5]]))


def test_a_folder_with_an_index_is_read_by_it(streamed):
    folder, index = streamed
    read_index(folder, index)
    assert read(folder).num_gaussians == 40


def test_an_index_without_counts_is_an_older_one(streamed):
    folder, index = streamed
    assert read_index(folder, {k: v for k, v in index.items() if k not in ("version", "count", "counts")}).num_gaussians


def test_the_environment_is_part_of_each_level_and_is_told(streamed):
    folder, index = streamed
    found = read_index(folder, {**index, "environment": "env/meta.json"}, level=1)
    assert found.num_gaussians == 24
    assert "environment" in found.report.warnings[-1]


def test_units_of_other_degrees_are_filled_with_zeros(streamed):
    folder, index = streamed
    found = read_index(folder, {**index, "environment": "env/meta.json"})
    assert found.sh_degree == 1
    assert not found.sh_rest[40:].any()


def changed(index: dict, *path: object, to: object) -> dict:
    index = copy.deepcopy(index)
    place = index
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = to
    return index


LEAF = ("tree", "children", 0, "lods", "0")
BAD = {
    "no unit": (*LEAF, "file", -1),
    "a unit beyond": (*LEAF, "file", 2),
    "a float": (*LEAF, "offset", 0.5),
    "rows twice": (*LEAF, "offset", 20),
    "sums that differ": (*LEAF, "count", 24),
    "rows beyond the unit": ("tree", "children", 1, "lods", "0", {"file": 0, "offset": 40, "count": 15}),
    "a huge count": (*LEAF, "count", 1 << 31),
    "a level too many": ("tree", "children", 0, "lods", {"2": {"file": 0, "offset": 0, "count": 1}}),
    "a level in words": ("tree", "children", 0, "lods", {"one": {"file": 0, "offset": 0, "count": 1}}),
    "a box inside out": ("tree", "bound", {"min": [1.0] * 3, "max": [0.0] * 3}),
    "no box": ("tree", "bound", None),
    "a number of words": ("tree", "bound", {"min": ["a"] * 3, "max": [0.0] * 3}),
    "no tree": ("tree", None),
    "a list for a leaf": ("tree", "children", 0, []),
    "a leaf without levels": ("tree", "children", 0, {"bound": BOUND}),
    "rows and children": ("tree", {"bound": BOUND, "children": [], "lods": {}}),
    "no leaves": ("tree", {"bound": BOUND, "children": []}),
    "no levels": ("lodLevels", 0),
    "many levels": ("lodLevels", 1 << 40),
    "a version to come": ("version", 2),
    "wrong counts": ("counts", [39, 20]),
    "a path upwards": ("filenames", ["../0_0/meta.json", "1_0/meta.json"]),
    "an absolute path": ("filenames", ["/etc/meta.json", "1_0/meta.json"]),
    "an address": ("filenames", ["http://a.b/meta.json", "1_0/meta.json"]),
    "a backslash": ("filenames", ["..\\0_0/meta.json", "1_0/meta.json"]),
    "another file": ("filenames", ["0_0/passwd", "1_0/meta.json"]),
    "a unit that is not there": ("filenames", ["0_7/meta.json", "1_0/meta.json"]),
    "the same unit again": ("filenames", ["0_0/meta.json"] * 100_000),
    "an environment that is the index": ("environment", "lod-meta.json"),
    "an environment upwards": ("environment", "../env/meta.json"),
    "an environment of another kind": ("environment", 5),
}


def refused(folder: Path, index: dict | str, **options) -> str:
    tracemalloc.start()
    lines, message = refusal(lambda: read_index(folder, index, **options))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MEMORY
    assert lines < LINES
    assert message.startswith("lod-meta.json")
    assert len(message) < 300
    return message


@pytest.mark.parametrize("name", BAD)
def test_a_bad_index_is_refused_in_two_lines(streamed, name):
    folder, index = streamed
    refused(folder, changed(index, *BAD[name][:-1], to=BAD[name][-1]))


def deep(levels: int) -> str:
    head = '{"lodLevels":1,"filenames":["0_0/meta.json"],"tree":'
    node = f'{{"bound":{json.dumps(BOUND)},"children":['
    return head + node * levels + "]}" * levels + "}"


@pytest.mark.parametrize("index", ["[]", "{", '{"tree": NaN}', deep(100), deep(100_000)[:MAX_INDEX], "[" * 1_000_000,
                                   " " * (MAX_INDEX + 1)])  # fmt: skip
def test_text_that_is_no_index_is_refused(streamed, index):
    refused(streamed[0], index)


def test_a_million_nodes_are_refused(streamed):
    folder, index = streamed
    text = json.dumps({**index, "tree": {"bound": BOUND, "children": []}})
    refused(folder, text.replace('"children": []', '"children": [' + "1," * 1_000_001 + "1]"))


def test_a_link_out_of_the_folder_is_refused(streamed, tmp_path):
    folder, index = streamed
    (tmp_path / "lod").mkdir()
    os.symlink(folder / "0_0", tmp_path / "lod" / "0_0")
    assert "link" in refused(tmp_path / "lod", index)


def test_no_such_level_is_told(streamed):
    folder, index = streamed
    with pytest.raises(UserInputError, match="levels 0 to 1"):
        read_index(folder, index, level=2)


def test_limits_hold_for_a_level(streamed):
    folder, index = streamed
    assert "limit" in refused(folder, index, limits=Limits(max_gaussians=30))


def test_flipped_characters_give_a_scene_or_a_typed_error(streamed):
    folder, index = streamed
    sound = json.dumps({**index, "environment": "env/meta.json"})
    rng = np.random.default_rng(0)
    survived = 0
    for _ in range(300):
        text = bytearray(sound.encode())
        text[rng.integers(len(text))] = rng.integers(32, 127)
        try:
            found = read_index(folder, text.decode())
            survived += 1
            assert found.num_gaussians <= 64
        except (BitstreamError, UserInputError):
            pass
    assert 0 < survived < 300

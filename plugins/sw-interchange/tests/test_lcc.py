"""LCC of XGRIDS: each level is its rows, and what an index claims is held to the files beside it."""

import json
import os
import shutil
import struct
import subprocess
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from lcc_files import write_lcc
from refusals import refusal
from sw_interchange import read
from sw_interchange.scene import sigmoid

from splatwizard_core.api import SplatwizardError, UserInputError

SPLAT_TRANSFORM = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
MEMORY = 256 << 20
LINES = 100_000  # of Python; none needs a tenth


@pytest.fixture
def folder(tmp_path) -> Path:
    write_lcc(tmp_path)
    return tmp_path


@pytest.mark.parametrize("degree", [0, 3])
def test_each_level_is_its_rows(tmp_path, degree):
    made = write_lcc(tmp_path, degree=degree)
    for level, rows in enumerate((slice(0, 30), slice(30, 40))):
        found = read(tmp_path / "meta.lcc", level=level, frame=None)
        assert found.frame == "RFU"
        assert found.sh_degree == degree
        assert np.array_equal(found.means, made["means"][rows])
        assert np.allclose(found.log_scales, made["log_scales"][rows], atol=1e-5)
        assert np.allclose(sigmoid(found.opacity_logits), made["opacities"][rows], atol=1e-6)
        assert np.allclose(0.5 + 0.28209479177387814 * found.sh_dc, made["colors"][rows], atol=1e-6)
        assert np.abs(found.quats - made["quats"][rows]).max() < 2 / 1023  # 10 bits, and the fourth follows
        if degree:
            assert np.allclose(found.sh_rest, made["sh_rest"][rows], atol=1e-6)


def test_the_world_is_turned_from_z_up(folder):
    stored, found = read(folder / "meta.lcc", frame=None), read(folder / "meta.lcc")
    assert np.array_equal(found.means, stored.means[:, [0, 2, 1]] * [1, -1, 1])


@pytest.mark.slow
@pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="no splat-transform: make test-interchange")
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("level", [0, 1])
def test_splat_transform_reads_the_same(tmp_path, degree, level):
    write_lcc(tmp_path, degree=degree)
    theirs = tmp_path / "theirs.ply"
    command = [SPLAT_TRANSFORM, "-q", "-w", "-g", "cpu", "-L", str(level), str(tmp_path / "meta.lcc"), str(theirs)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    found, expected = read(tmp_path / "meta.lcc", level=level), read(theirs)
    assert found.num_gaussians == expected.num_gaussians
    for name in ("means", "log_scales", "sh_dc", "opacity_logits"):
        assert np.allclose(getattr(found, name), getattr(expected, name), atol=1e-6), name
    # It keeps SH columns of zeros where there are none.
    rest = np.zeros_like(expected.sh_rest)
    rest[:, : found.sh_rest.shape[1]] = found.sh_rest
    assert np.allclose(rest, expected.sh_rest, atol=1e-6)
    assert np.allclose(np.abs((found.quats * expected.quats).sum(1)), 1, atol=1e-6)


def refused(path: Path, **options: object) -> str:
    tracemalloc.start()
    lines, message = refusal(lambda: read(path, **options))
    assert lines < LINES
    assert tracemalloc.get_traced_memory()[1] < MEMORY
    tracemalloc.stop()
    assert message.startswith("meta.lcc")
    assert len(message) < 300
    return message


def cells(*entries: tuple[int, int, int]) -> bytes:
    """Cells whose two levels both are an entry (points, offset, bytes)."""
    return b"".join(struct.pack("<hh", 0, 0) + 2 * struct.pack("<iqi", *entry) for entry in entries)


BAD_INDEX = {
    "beyond the file": cells((30, 32 * 30, 32 * 30)),
    "a negative count": cells((-1, 0, -32)),
    "a negative place": cells((1, -32, 32)),
    "other bytes": cells((2, 0, 32)),
    "a huge place": cells((1, 2**63 - 1, 32)),
    "a huge count": cells((2**31 - 1, 0, -32)),
    "rows twice": cells((10, 0, 320), (10, 32, 320)),
    "the same rows again": cells((40, 0, 1280)) * 1000,
    "cut": cells((1, 0, 32))[:-1],
    "empty": b"",
    "nothing in it": cells((0, 0, 0)),
}


@pytest.mark.parametrize("name", BAD_INDEX)
def test_a_bad_index_is_refused(folder, name):
    (folder / "index.bin").write_bytes(BAD_INDEX[name])
    refused(folder / "meta.lcc")


BAD_META = {
    "no levels": {"totalLevel": 0},
    "many levels": {"totalLevel": 1 << 30},
    "no attributes": {"attributes": None},
    "no scale": {"attributes": []},
    "a range inside out": {"attributes": [{"name": "scale", "min": [1, 1, 1], "max": [0, 0, 0]}]},
    "scales below zero": {"attributes": [{"name": "scale", "min": [-1, 0, 0], "max": [1, 1, 1]}]},
    "words": {"attributes": [{"name": "scale", "min": ["a"] * 3, "max": [1, 1, 1]}]},
    "huge": {"attributes": [{"name": "scale", "min": [0] * 3, "max": [1e300] * 3}]},
}


@pytest.mark.parametrize("name", BAD_META)
def test_a_bad_description_is_refused(folder, name):
    meta = json.loads((folder / "meta.lcc").read_text())
    (folder / "meta.lcc").write_text(json.dumps(meta | BAD_META[name]))
    refused(folder / "meta.lcc")


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, '{"attributes": NaN}', " " * (1 << 21)])
def test_text_that_is_no_description_is_refused(folder, text):
    (folder / "meta.lcc").write_text(text)
    refused(folder / "meta.lcc", format="lcc")


@pytest.mark.parametrize("name", ["index.bin", "data.bin", "shcoef.bin"])
def test_a_file_that_is_missing_or_short_is_told(folder, name):
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: len(content) // 2 - 1])
    assert name in refused(folder / "meta.lcc")
    (folder / name).unlink()
    assert name in refused(folder / "meta.lcc")


def test_a_link_beside_the_description_is_followed(folder, tmp_path):
    count = len(read(folder / "meta.lcc").means)
    (folder / "data.bin").rename(tmp_path / "elsewhere.bin")
    (folder / "data.bin").symlink_to(tmp_path / "elsewhere.bin")
    assert len(read(folder / "meta.lcc").means) == count


def test_no_such_level_is_told(folder):
    with pytest.raises(UserInputError, match="levels 0 to 1"):
        read(folder / "meta.lcc", level=2)


def test_flipped_bytes_give_a_scene_or_a_typed_error(folder):
    rng = np.random.default_rng(0)
    survived = 0
    for _ in range(300):
        path = folder / ("index.bin", "meta.lcc", "data.bin")[rng.integers(3)]
        sound = path.read_bytes()
        damaged = bytearray(sound)
        damaged[rng.integers(len(damaged))] ^= 1 << rng.integers(8)
        path.write_bytes(bytes(damaged))
        try:
            assert read(folder / "meta.lcc").num_gaussians <= 40
            survived += 1
        except SplatwizardError:
            pass
        path.write_bytes(sound)
    assert 0 < survived < 300

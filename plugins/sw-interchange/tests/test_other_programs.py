"""Against independent implementations, in both directions: splat-transform (npm) and gsply (PyPI).

They are installed outside of this project, by `make test-interchange`; without them the tests are skipped.

SPLAT_TRANSFORM     the command, such as /somewhere/node_modules/.bin/splat-transform
GSPLY_PYTHON        a Python that imports gsply
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from interchange_files import covariances, random_scene
from scipy.spatial import cKDTree
from sw_interchange import GaussianScene, read, write
from sw_interchange.scene import sigmoid

SPLAT_TRANSFORM = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
GSPLY = os.environ.get("GSPLY_PYTHON")
N = 900
GSPLY_PROGRAM = """
import sys, gsply
source, target = sys.argv[1:]
data = gsply.read_spz(source) if source.endswith(".spz") else gsply.plyread(source)
gsply.write_spz(target, data) if target.endswith(".spz") else gsply.plywrite(
    target, data, compressed=target.endswith(".compressed.ply"))
"""
with_splat_transform = pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="no splat-transform: make test-interchange")
with_gsply = pytest.mark.skipif(GSPLY is None, reason="no gsply: make test-interchange")


def by_splat_transform(source: Path, target: Path, *options: str) -> None:
    assert SPLAT_TRANSFORM is not None
    command = [SPLAT_TRANSFORM, "-w", "-g", "cpu", str(source), *options, str(target)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)


def by_gsply(source: Path, target: Path) -> None:
    assert GSPLY is not None
    command = [GSPLY, "-c", GSPLY_PROGRAM, str(source), str(target)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)


def check(scene: GaussianScene, found: GaussianScene, **bounds: float) -> None:
    """Hold each field to its bound; rows are matched by place, since some formats have an order of their own."""
    rows = cKDTree(found.means).query(scene.means)[1]
    assert len(set(rows.tolist())) == scene.num_gaussians == found.num_gaussians
    found = found.select(rows)
    assert found.sh_degree == scene.sh_degree
    errors = {name: float(np.abs(getattr(scene, name) - getattr(found, name)).max(initial=0)) for name in
              ("means", "log_scales", "sh_dc", "sh_rest")}  # fmt: skip
    errors["alpha"] = float(np.abs(sigmoid(scene.opacity_logits) - sigmoid(found.opacity_logits)).max())
    ours, theirs = covariances(scene), covariances(found)
    errors["shape"] = float((np.abs(ours - theirs).max((1, 2)) / np.abs(ours).max((1, 2))).max())
    for name, error in errors.items():
        assert error <= bounds.get(name, 0) + 1e-5, name


SPZ = {"means": 1.2208e-4, "log_scales": 1 / 32, "sh_dc": 0.01308, "alpha": 1 / 255, "sh_rest": 8.5 / 128, "shape": 0.1}
PACKED = {"means": 0.02, "log_scales": 0.01, "sh_dc": 0.02, "alpha": 1 / 510, "sh_rest": 1 / 32, "shape": 0.02}
SOG = {"means": 1e-3, "log_scales": 0.05, "alpha": 1 / 255, "sh_rest": 2, "shape": 0.15,
       "sh_dc": 8}  # what it writes loses colours where alpha is 0  # fmt: skip
RAW = {"frame": "raw"}  # since 3.0 splat-transform turns nothing when it reads and writes .spz
CASES = [("spz", (), SPZ), ("spz", ("--spz-version", "3"), SPZ), ("compressed.ply", (), PACKED), ("sog", (), SOG)]


@pytest.fixture(params=[0, 1, 3], ids=lambda degree: f"degree{degree}")
def scene(request) -> GaussianScene:
    return random_scene(N, request.param)


@with_splat_transform
@pytest.mark.parametrize(("suffix", "options", "bounds"), CASES)
def test_splat_transform_reads_what_is_written_here(scene, suffix, options, bounds, tmp_path):
    """Exactly: both decode the same bytes."""
    ours, theirs = tmp_path / f"ours.{suffix}", tmp_path / "theirs.ply"
    write(scene, ours, **(RAW if suffix == "spz" else {}), **({} if options or suffix != "spz" else {"version": 4}))
    by_splat_transform(ours, theirs)
    check(read(ours, spz_frame="raw"), read(theirs), sh_rest=1 / 64 if suffix == "compressed.ply" else 0)


@with_splat_transform
@pytest.mark.parametrize(("suffix", "options", "bounds"), CASES)
def test_what_splat_transform_writes_is_read_here(scene, suffix, options, bounds, tmp_path):
    source, theirs, back = tmp_path / "scene.ply", tmp_path / f"theirs.{suffix}", tmp_path / "back.ply"
    write(scene, source)
    by_splat_transform(source, theirs, *options)
    found = read(theirs, spz_frame="raw")
    check(scene, found, **bounds)
    by_splat_transform(theirs, back)
    check(read(back), found)


@with_splat_transform
def test_splat_transform_reads_a_splat_and_writes_gltf(scene, tmp_path):
    write(scene, tmp_path / "ours.splat")
    by_splat_transform(tmp_path / "ours.splat", tmp_path / "theirs.ply")
    # It decodes rotations by b / 127.5 - 1: the identity is 0.8 degrees off.
    check(read(tmp_path / "ours.splat"), read(tmp_path / "theirs.ply"), shape=0.06)
    write(scene, tmp_path / "scene.ply")
    by_splat_transform(tmp_path / "scene.ply", tmp_path / "theirs.glb")
    check(scene, read(tmp_path / "theirs.glb"), shape=1e-4)


@with_gsply
@pytest.mark.parametrize("suffix", ["ply", "spz", "compressed.ply"])
def test_gsply_reads_what_is_written_here(scene, suffix, tmp_path):
    ours, theirs = tmp_path / f"ours.{suffix}", tmp_path / "theirs.ply"
    write(scene, ours, **({"frame": "raw"} if suffix == "spz" else {}))
    by_gsply(ours, theirs)
    # It reads 8-bit SH as 8 b / 255 - 4, and clamps opacities in a way of its own.
    bounds = {"sh_rest": 1 / 32, "alpha": 1e-4} if suffix == "compressed.ply" else {}
    check(read(ours, spz_frame="raw"), read(theirs), **bounds)


@with_gsply
@pytest.mark.parametrize(("suffix", "bounds"), [("ply", {}), ("spz", SPZ), ("compressed.ply", PACKED)])
def test_what_gsply_writes_is_read_here(scene, suffix, bounds, tmp_path):
    source, theirs = tmp_path / "scene.ply", tmp_path / f"theirs.{suffix}"
    write(scene, source)
    by_gsply(source, theirs)
    check(scene, read(theirs, spz_frame="raw"), **bounds)

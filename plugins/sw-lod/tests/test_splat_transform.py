"""Streamed SOG against splat-transform (npm), both ways; see `make test-interchange`.

SPLAT_TRANSFORM     the command, such as /somewhere/node_modules/.bin/splat-transform
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from sw_gaussians.simplifying import merged_to
from sw_interchange import GaussianScene, from_gaussians, read, write
from sw_lod import write_lod

SPLAT_TRANSFORM = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="no splat-transform: make test-interchange"),
]


def transform(*words: object) -> str:
    assert SPLAT_TRANSFORM is not None
    command = [SPLAT_TRANSFORM, "-q", "-w", "-g", "cpu", *map(str, words)]
    return subprocess.run(command, check=True, capture_output=True, timeout=300, text=True).stdout


def same(found: GaussianScene, expected: GaussianScene) -> None:
    """Hold a scene to another, row by row in any order."""
    far, rows = cKDTree(found.means).query(expected.means)
    assert found.num_gaussians == expected.num_gaussians == len(set(rows.tolist()))
    assert far.max() == 0
    for name in ("log_scales", "sh_dc", "sh_rest"):
        assert np.array_equal(getattr(found, name)[rows], getattr(expected, name)), name


def test_it_reads_every_level_that_is_written_here(model, tmp_path):
    index = tmp_path / "lod" / "lod-meta.json"
    write_lod(model, index, levels=3, chunk=400, device="cpu")
    told = json.loads(transform(index, "--info", "json", "null"))
    assert told["lodCounts"] == [1200, 600, 300]
    for level in range(3):
        transform("--select-lod", level, index, tmp_path / "level.ply")
        same(read(tmp_path / "level.ply"), read(index, level=level))


def test_levels_that_it_writes_are_read_here(model, tmp_path):
    fine, coarse = tmp_path / "0.ply", tmp_path / "1.ply"
    write(from_gaussians(model), fine)
    write(from_gaussians(merged_to(model, 500)), coarse)
    index = tmp_path / "lod" / "lod-meta.json"
    transform(fine, "-l", 0, coarse, "-l", 1, index)
    for level in range(2):
        transform("--select-lod", level, index, tmp_path / "level.ply")
        same(read(index, level=level), read(tmp_path / "level.ply"))


def test_the_finest_level_is_as_good_as_a_plain_sog(model, tmp_path: Path):
    """Each unit has codebooks of its own, so its values are not further off than those of one file."""
    scene = from_gaussians(model)
    write_lod(model, tmp_path / "lod-meta.json", levels=2, chunk=400, device="cpu")
    write(scene, tmp_path / "plain.sog")
    errors = []
    for found in (read(tmp_path / "lod-meta.json"), read(tmp_path / "plain.sog")):
        rows = cKDTree(found.means).query(scene.means)[1]
        errors.append(np.sqrt(np.mean((found.sh_dc[rows] - scene.sh_dc) ** 2)))
    assert errors[0] <= 1.1 * errors[1]

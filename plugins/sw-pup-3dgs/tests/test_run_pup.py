"""From the command to the record: a trained scene, removals, a file that a fresh process decodes."""

import json

import pytest
from safetensors.torch import load_file

from splatwizard_core.cli.main import main

SETS = ["iterations=30", "prune.steps=[1,16]"]


@pytest.mark.pipeline
def test_a_run_ends_with_a_record_of_fewer_gaussians(tmp_path):
    # Six views of 64 x 48 pixels; the 3DGS scene that it starts from is trained first.
    sets = [f"--set={pair}" for pair in (*SETS, "pretrained.iterations=30", "codec=gaussians-zstd")]
    status = main(["run", "--method", "pup-3dgs", "--scene", "demo:tiny", "--out", str(tmp_path), *sets])
    assert status == 0
    (path,) = tmp_path.glob("demo-tiny/pup-3dgs/r3/metrics.json")
    record = json.loads(path.read_text())
    (trained,) = tmp_path.glob(".trained/*/checkpoints/*.safetensors")
    before = len(load_file(trained)["model/means"])
    left = before - int(0.8 * before)
    assert record["counts"]["num_gaussians"] == left - int(0.5 * left)

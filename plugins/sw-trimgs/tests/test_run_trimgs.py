"""From the command to the record: a trained scene, trims, a file that a fresh process decodes."""

import json

import pytest

from splatwizard_core.cli.main import main


@pytest.mark.pipeline
@pytest.mark.slow
@pytest.mark.parametrize(("method", "before"), [("trim-3dgs", "flat-3dgs"), ("trim-2dgs", "2dgs")])
def test_a_run_ends_with_a_record(tmp_path, method, before):
    sets = ["--set=iterations=12", "--set=pretrained.iterations=20"]
    status = main(["run", "--method", method, "--scene", "demo:tiny", "--rate", "r3", "--out", str(tmp_path), *sets])
    assert status == 0
    record = json.loads((tmp_path / "demo-tiny" / method / "r3" / "metrics.json").read_text())
    assert before in record["train"]["pretraining"]
    assert record["counts"]["num_gaussians"] > 0
    used = {part["name"] for phase in record["phases"] for part in phase["provided_by"]}
    assert {"trimgs", "gaussians-quantized"} <= used

"""From the command to the record: a trained scene, an octree, a file that a fresh process decodes."""

import json

import pytest

from splatwizard_core.cli.main import main

SETS = ["iterations=12", "pretrained.iterations=20", "codec.settings.codebook_size=16", "codec.settings.vq_steps=3"]


def test_the_schedule_says_what_is_looked_up_for_the_scene(capsys):
    assert main(["schedule", "mesongs", "--set", "lr.factor=1", "--set", "codec.settings.depth=9"]) == 0
    left = "prune.tau, prune.settings.beta, codec.settings.blocks, codec.settings.codebook_size"
    assert f"; looked up for the scene: {left}\n" in capsys.readouterr().out
    assert main(["schedule", "3dgs"]) == 0
    assert "looked up" not in capsys.readouterr().out


@pytest.mark.pipeline
def test_a_run_ends_with_a_record_of_a_small_file(tmp_path):
    # Six views of 64 x 48 pixels; the 3DGS scene that it starts from is trained first.
    sets = [f"--set={pair}" for pair in SETS]
    status = main(["run", "--method", "mesongs", "--scene", "demo:tiny", "--rate", "r2", "--out", str(tmp_path), *sets])
    assert status == 0
    (path,) = tmp_path.glob("demo-tiny/mesongs/r2/metrics.json")
    record = json.loads(path.read_text())
    count = record["counts"]["num_gaussians"]
    assert 0 < record["file"]["bytes"] < 248 * count / 4
    assert record["config"]["config"]["authors"]["point"] == "c3"
    lines = [json.loads(line) for line in path.with_name("log.jsonl").read_text().splitlines()]
    (said,) = (line["said"] for line in lines if line.get("said", "").startswith("scene 'demo"))
    assert "prune.tau = 0.3, prune.settings.beta = 0.1, codec.settings.depth = 14, " in said
    left = {"prune.tau": 0.3, "prune.settings.beta": 0.1, "codec.settings.blocks": 57}
    assert record["plan"][0]["looked_up"] == left  # the preset sets the others
    assert said.endswith("codec.settings.blocks = 57, codec.settings.codebook_size = 16, lr.factor = 1")

"""docs/api.md and docs/first_steps.ipynb: their code runs as it stands, in one folder, so that `run` trains once."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from import_graph import ROOT

import splatwizard_core as sw
from splatwizard_core.api import BitstreamError, ConfigError

DOCS = ROOT / "docs"
PAGE = (DOCS / "api.md").read_text("utf-8")
NOTEBOOK = DOCS / "first_steps.ipynb"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The folder in which the blocks of the page were executed, and their variables."""
    folder = tmp_path_factory.mktemp("api")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        variables: dict[str, Any] = {}
        for block in BLOCKS:
            exec(compile(block, "docs/api.md", "exec"), variables)
        yield folder, variables


def test_the_blocks_of_the_page_do_what_it_says(followed):
    folder, variables = followed
    record, scene, decoded = (variables[name] for name in ("record", "scene", "decoded"))
    assert (record.method, record.rate, record.train.steps) == ("3dgs", "r2", 100)
    assert json.loads((folder / "out/demo-tiny/3dgs/r2/metrics.json").read_text())["file"]["bytes"] == record.file.bytes
    assert variables["file"].stat().st_size > record.file.bytes, "r3 is larger than r2"
    camera = scene.test[0].camera
    assert variables["image"].shape == (3, camera.height, camera.width)
    assert decoded.model.counts() == variables["trained"].model.counts()
    # The page says: ten lines.
    assert len([line for line in BLOCKS[0].splitlines() if line.strip()]) <= 10


def test_scores_are_those_of_the_picture_that_render_draws(followed):
    scene, decoded, scores = (followed[1][name] for name in ("scene", "decoded", "scores"))
    view = scene.test[0]
    image = sw.render(decoded, view, background=scene.background).image
    error = (image.mul(255).round().div(255) - view.image(scene.background)).square().mean()
    assert -10 * torch.log10(error).item() == pytest.approx(scores["metrics"]["psnr"]["per_view"][0], abs=1e-3)


def test_values_of_options_reach_the_run(followed):
    folder, _ = followed
    written = (folder / "fewer/demo-tiny/3dgs/r2/config.toml").read_text()
    assert "grad_threshold = 0.0004" in written
    assert sw.load_scene("demo:tiny", resolution=2).test[0].camera.width == 32


def test_what_is_wrong_is_raised_as_the_commands_say_it(followed, tmp_path):
    with pytest.raises(ConfigError, match=r"iteration.*iterations"):
        sw.train("3dgs", "demo:tiny", iteration=5)
    damaged = tmp_path / "damaged.swz"
    damaged.write_bytes(followed[1]["file"].read_bytes()[:-40])
    with pytest.raises(BitstreamError):
        sw.decode(damaged)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = sw.nothing


def test_the_page_names_every_function_and_importing_them_is_light():
    assert re.findall(r"^\| `(\w+)\(", PAGE, re.M) == [
        "run", "train", "encode", "decode", "load_scene", "evaluate", "render",
    ]  # fmt: skip
    assert sorted(sw.__all__) == sorted(re.findall(r"^\| `(\w+)\(", PAGE, re.M))
    program = "import sys, splatwizard_core; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_the_cells_of_the_notebook_run_in_order(followed, capsys):
    cells = [cell for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]
    variables: dict[str, Any] = {}
    for cell in cells:
        exec(compile("".join(cell["source"]), NOTEBOOK.name, "exec"), variables)
    sizes = [int(size.replace(",", "")) for size in re.findall(r"^r\d: +([\d,]+) bytes", capsys.readouterr().out, re.M)]
    assert sizes == sorted(sizes)
    assert len(sizes) == 3
    assert variables["picture"].size == (3 * 64, 48)
    for cell in cells:
        assert all(output.get("output_type") != "error" for output in cell["outputs"])


@pytest.mark.slow  # a kernel of its own, which compiles and imports anew
def test_jupyter_executes_the_notebook(tmp_path):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert "image/png" in notebook.cells[-1].outputs[-1]["data"]


def test_several_rate_points_are_refused_as_foreseen():
    with pytest.raises(ConfigError, match="one rate point"):
        sw.run("3dgs", "demo:tiny", rate="all")

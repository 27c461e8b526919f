"""The golden files decode to what they always decoded to, and today's encoder still writes them."""

import hashlib
import importlib.util
import json
from pathlib import Path

import pytest

from splatwizard_core.cli.main import main
from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import decode_model

GOLDEN = Path(__file__).parent / "golden"
ROOT = Path(__file__).parents[1]
FACTS = json.loads((GOLDEN / "golden.json").read_text())
FOREIGN = {"spz", "sog", "splat", "compressed-ply", "tmc13"}
"""Methods whose file is a format of others, or a program's: their bytes are in the tests of sw-interchange."""


@pytest.fixture(scope="module")
def maker():
    spec = importlib.util.spec_from_file_location("make_golden", GOLDEN / "make_golden.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_golden_file_has_its_facts_and_its_recipe(maker):
    files = {path.stem for path in GOLDEN.glob("*.swz")}
    assert files == set(FACTS) == set(maker.CASES)


def test_every_method_of_the_workspace_has_golden_files(maker):
    ours = {path.parent.name for path in ROOT.glob("plugins/*/pyproject.toml")}
    methods = {entry.name for entry in load_plugins().methods if entry.distribution in ours}
    assert methods - FOREIGN == {case[0] for case in maker.CASES.values()}


@pytest.mark.parametrize("name", FACTS)
def test_a_golden_file_decodes_to_the_recorded_parameters(maker, name):
    data = (GOLDEN / f"{name}.swz").read_bytes()
    facts = dict(FACTS[name])
    assert (len(data), hashlib.sha256(data).hexdigest()) == (facts.pop("bytes"), facts.pop("sha256")), (
        "it was rewritten"
    )
    assert maker.decoded_facts(data, name) == facts


@pytest.mark.parametrize("name", FACTS)
def test_todays_encoder_writes_the_same_sections_and_the_same_model(maker, name):
    """If the bytes change on purpose, the old file stays, and a new one is made under a new name (`_v2`)."""
    if name in maker.REORDERED:
        return
    written = maker.SUPERSEDED.get(name, name)
    fresh, golden = ContainerReader(maker.encoded(name), name), ContainerReader.open(GOLDEN / f"{written}.swz")
    assert maker.decoded_facts(maker.encoded(name), name)["parameters"] == FACTS[name]["parameters"]
    assert (fresh.method, fresh.version, fresh.static) == (golden.method, golden.version, golden.static)
    assert {s: fresh.section(s) for s in fresh.sections} == {s: golden.section(s) for s in golden.sections}


def test_the_hash_for_other_decoders_is_over_the_parameters_in_their_order(capsys):
    path = GOLDEN / "3dgs_r1_v1.swz"
    model = decode_model(ContainerReader.open(path), load_plugins())
    values = (model.means, model.log_scales, model.quats, model.opacity_logits, model.sh_dc, model.sh_rest)
    content = b"".join(value.detach().numpy().astype("<f4").tobytes() for value in values)
    assert main(["decode", str(path), "--hash"]) == 0
    assert capsys.readouterr().out == f"{hashlib.sha256(content).hexdigest()}\n"


def test_golden_files_are_small():
    assert sum(path.stat().st_size for path in GOLDEN.glob("*.swz")) < 185_000

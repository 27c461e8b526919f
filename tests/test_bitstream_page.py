"""docs/bitstream.md is enough: a reader written from it alone decodes real files to the parameters that ours gives."""

import ast
import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path

import bitstream_page
import numpy as np
import pytest
import torch
import zstandard
from bitstream_page import container as page_container
from bitstream_page import decoded_hash, entropy_coders, entropy_models, method_files, positions
from sw_reference.projection import rotation_matrices

from splatwizard_core.base import strict_json
from splatwizard_core.cli.main import main
from splatwizard_core.coding import container, limits
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import open_model
from sw_codecs.entropy import column_plan
from sw_codecs.positions import point_limit
from sw_wisp import file as wisp_file
from sw_wisp.context import ContextNetworks
from sw_wisp.cube import Cube
from sw_wisp.eight_bits import EightBitLayer
from sw_wisp.numbers import BASE_STEPS

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "docs" / "bitstream.md"
READER = sorted(Path(bitstream_page.__file__).parent.glob("*.py"))
CODECS = TESTS.parent / "plugins" / "sw-codecs"
EXACT_TABLES = CODECS / "src" / "sw_codecs" / "data" / "exact_tables.bin"
GOLDEN = sorted((TESTS / "golden").glob("*.swz"))
WISP = [path for path in GOLDEN if path.stem.startswith("wisp")]
RATES = ("r1", "r6")


def load(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def assert_page_agrees(path: Path) -> dict[str, np.ndarray]:
    """Decode a file both ways; the parameters must be the same to the bit."""
    model, _ = open_model(path, load_plugins(), torch.device("cpu"))
    tables = entropy_models.ExactTables(EXACT_TABLES.read_bytes())
    found = method_files.decode(path.read_bytes(), zstandard.ZstdDecompressor().decompress, tables)
    ours = {name: parameter.numpy() for name, parameter in model.named_parameters()}
    assert set(found) == set(ours)
    for name, array in ours.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape), name
        assert found[name].tobytes() == array.tobytes(), name
    assert decoded_hash.parameter_hash(found) == model.parameter_hash()
    return found


@pytest.mark.parametrize("path", READER, ids=lambda path: path.stem)
def test_the_reader_shares_no_code_with_the_packages(path):
    tree = ast.parse(path.read_text())
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert all(node.level == 0 for node in froms), "a relative import"
    imported |= {node.module for node in froms}
    foreign = {name.partition(".")[0] for name in imported} - set(sys.stdlib_module_names)
    assert foreign <= {"numpy", bitstream_page.__name__}
    called = {node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    assert not called & {"__import__", "exec", "eval"}


def test_the_reader_has_a_file_for_each_chapter_of_the_page():
    """But the last, which is about what a reader refuses."""
    chapters = re.findall(r"^## (\d [^(\n]+?)(?: \(.*| `.*)?$", PAGE.read_text(), re.MULTILINE)
    *described, refused = chapters
    assert refused == "8 What a file may claim"
    opening = "\n".join(path.read_text().partition("\n")[0] for path in READER)
    for number, _, title in (chapter.partition(" ") for chapter in described):
        assert f"Chapter {number}: {title}" in opening


@pytest.mark.parametrize("path", [path for path in GOLDEN if path not in WISP], ids=lambda path: path.stem)
def test_it_decodes_the_golden_files(path):
    assert_page_agrees(path)


def assert_page_agrees_on_splats(path: Path) -> None:
    """Integers must be the same to the bit; behind them stand floats, which are not the same on every machine."""
    model, _ = open_model(path, load_plugins(), torch.device("cpu"))
    ours = wisp_file.decode(container.ContainerReader.open(path)).state
    tables = entropy_models.ExactTables(EXACT_TABLES.read_bytes())
    found = method_files.decode(path.read_bytes(), zstandard.ZstdDecompressor().decompress, tables)
    integers = {
        "levels": ours.levels,
        "cells": ours.cells.places,
        "mean": ours.mean,
        "m": ours.multiplier,
        "k": ours.index,
    }
    for name, array in integers.items():
        assert np.array_equal(found[name], array), name
    parameters = {name: parameter.detach().numpy() for name, parameter in model.named_parameters()}
    assert found["means"].tobytes() == parameters["means"].tobytes()
    for name in ("opacity_logits", "sh_dc", "sh_rest"):
        assert found[name].shape == parameters[name].shape
        assert np.allclose(found[name], parameters[name], rtol=1e-5, atol=1e-5), name
    axes = rotation_matrices(model.quats) * model.log_scales.exp()[:, None]
    assert np.allclose(found["covariances"], (axes @ axes.transpose(1, 2)).detach(), rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("path", WISP, ids=lambda path: path.stem)
def test_it_decodes_the_golden_files_of_splats(path):
    assert_page_agrees_on_splats(path)


@pytest.mark.parametrize(("context", "planes"), [("none", 1), ("large", 2), ("small", 0)])
def test_it_decodes_splats_in_packets(context, planes, tmp_path):
    """Three subsets, refinements, crowds and escapes, all SH bands, and values drawn towards centroids."""
    rng, draws, n = np.random.default_rng(0), torch.Generator().manual_seed(0), 80
    net = ContextNetworks(size="large" if context == "none" else context, generator=draws)
    for weight in net.parameters():
        weight.data.copy_(torch.randn(weight.shape, generator=draws) * 0.2)
    for network, width in zip(net.networks, (1, 6, 3, 12), strict=True):
        network[-1].bias.data[width : 2 * width] = 30.0
    places = torch.from_numpy(rng.random((n, 3)) ** 3)
    cube = Cube.around(places)
    levels, cells = cube.settled(places, torch.from_numpy(rng.choice([3, 4, 7, 8, 18], n)), torch.arange(n))
    values = rng.normal(0, 3, (n, 22)) * np.array(BASE_STEPS)
    values[::9] *= 40
    layers = [
        EightBitLayer.nearest(rng.normal(0, 0.1, s), rng.normal(0, 0.1, s[0])) for s in ((45, 12), (32, 15), (45, 32))
    ]
    scene = wisp_file.Scene(
        cube, levels, cells, values, (replace(layers[0], bias=np.zeros(0, np.int16)), *layers[1:]), planes=planes,
        subsets=rng.choice(3, n, p=[0.2, 0.5, 0.3]), context=None if context == "none" else net.exact(),
        strengths=rng.random((planes + 1, 5)), swell=[rng.integers(-40, 41, 2 * j).tolist() for j in (1, 2)],
    )  # fmt: skip
    writer = container.ContainerWriter("wisp", 1)
    wisp_file.encode(scene, writer)
    path, data = tmp_path / "scene.swz", writer.to_bytes()
    ends = [cut["bytes"] for cut in container.ContainerReader(data).summary()["cuts"]]
    assert len(ends) == 3 * (2 + planes)
    for end in (ends[0], ends[3], ends[-1]):  # prefixes in which subsets and latents are missing, and the whole
        path.write_bytes(data[:end])
        assert_page_agrees_on_splats(path)


def test_it_decodes_a_golden_file_that_ends_at_a_cut(tmp_path):
    path, data = tmp_path / "short.swz", (TESTS / "golden" / "3dgs_packets_v1.swz").read_bytes()
    ends = [cut["bytes"] for cut in container.ContainerReader(data).summary()["cuts"]]
    assert len(ends) == 4
    for end in ends[:-1]:
        path.write_bytes(data[:end])
        assert_page_agrees(path)


def test_the_page_names_every_header_value_and_section():
    text = PAGE.read_text()
    for path in GOLDEN:
        header, sections = page_container.container(path.read_bytes())
        for name in (*header, *header["static"], *sections):
            name = re.sub(r"^([2-9]|[1-9]\d+)/", "1/", name)  # those of packet 1 stand for all
            name = re.sub(r"^packet\.\d\d$", "packet.01", name)
            assert f"`{name}`" in text or f"`{name.removeprefix('1/')}`" in text, f"{path.stem}: {name}"


def test_the_page_states_the_caps_of_the_code():
    text = PAGE.read_text()
    assert f"at most {container.MAX_HEADER:,} |" in text
    assert (
        f"{container.MAX_HEADER >> 10} KiB, {strict_json.MAX_DEPTH} levels, {container.MAX_SECTIONS:,} sections" in text
    )
    assert f"{limits.FREE >> 20} MiB + {limits.EXPANSION:,} for each byte of the sections" in text
    points = (
        f"above 2^{point_limit.ALWAYS_ALLOWED.bit_length() - 1} at most {point_limit.POINTS_PER_BYTE} for each byte"
    )
    assert text.count(points) == 2
    assert f"{column_plan.MAX_TABLE:,} entries a column" in text


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run directory: 3DGS on the smallest demo scene, all SH bands in use."""
    out = tmp_path_factory.mktemp("trained")
    pairs = ("iterations=150", "sh_interval=25", "density.settings.start=40", "density.settings.interval=20")
    sets = [f"--set={pair}" for pair in pairs]
    assert main(["train", "--method", "3dgs", "--scene", "demo:tiny", "--out", str(out), *sets]) == 0
    (directory,) = (path.parent for path in out.glob("**/config.toml"))
    return directory


@pytest.mark.pipeline
@pytest.mark.parametrize("rate", RATES)
def test_it_decodes_a_trained_model(trained, tmp_path, rate):
    path = tmp_path / f"{rate}.swz"
    assert main(["encode", str(trained), "--rate", rate, "--out", str(path)]) == 0
    header, _ = page_container.container(path.read_bytes())
    assert header["static"]["active_sh_degree"] == 3
    found = assert_page_agrees(path)
    assert len(found["means"]) > 300
    assert np.abs(found["sh_rest"][:, 8:]).max() > 0


@pytest.mark.parametrize("name", load(CODECS / "tests" / "test_golden_codecs.py").CASES)
def test_it_decodes_the_payload_of_every_coder_and_entropy_model(name):
    cases = load(CODECS / "tests" / "test_golden_codecs.py")
    tables = [row.astype(int).tolist() for row in cases.tables.counts]
    numbers = cases.tables.index.tolist()
    contexts = [getattr(cases.context, field).tolist() for field in ("mean", "scale", "multiplier")]
    exact = entropy_models.ExactTables(EXACT_TABLES.read_bytes())
    unzstd = zstandard.ZstdDecompressor().decompress
    decoders = {
        "columns_v1": lambda data: np.transpose(entropy_models.columns(data, *cases.matrix.shape)),
        "categorical_v1": lambda data: entropy_models.categorical(data, 9, 3, cases.categorical.index.tolist()),
        "bernoulli_v1": lambda data: entropy_models.bernoulli(data, 300),
        **dict.fromkeys(
            ("gaussian_exact_v1", "gaussian_exact_v2"), lambda data: entropy_models.exact(data, exact, *contexts)
        ),
        "octree_v1": positions.octree,
        "byte_planes_v1": lambda data: positions.byte_planes(data, "i2", cases.halves.shape, unzstd),
        "byte_planes_plain_v1": lambda data: positions.byte_planes(data, "i8", cases.hashes.shape, unzstd),
        "float_delta_v1": lambda data: positions.float_delta(data, cases.floats.shape, unzstd),
        "packed_bits_v1": lambda data: positions.packed_bits(data, 300, 12),
        **{
            coder: lambda data, coder=coder: entropy_coders.coder_symbols(coder, data, tables, numbers)
            for coder in ("range", "rans", "huffman")
        },
    }
    data = (CODECS / "tests" / "golden" / f"{name}.bin").read_bytes()
    assert np.array_equal(decoders[name](data), cases.CASES[name][2])

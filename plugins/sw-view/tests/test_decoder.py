"""The WebAssembly decoder gives what the Python decoder gives, in wasmtime, Node and Chromium.

`make test-wasm` runs it; each test skips where its engine is not installed.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from decoder_engines import SCRIPT, Wasmtime, in_chromium, in_node, in_python, opened, served
from headless_chromium import find_chromium
from PIL import Image
from sw_anchors.anchors import AnchorSplats
from sw_gaussians.surfels import as_ellipsoids
from sw_view.coded_file import covers

from splatwizard_core.api import SH_C0, Camera, GaussianModel, SplatModel
from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.coding.cuts import Prefix
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import decode_model

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[3]
THREE = ROOT / "build" / "three" / "node_modules"
GOLDEN = sorted((ROOT / "tests" / "golden").glob("*.swz"))
PACKETS = ROOT / "tests" / "golden" / "3dgs_packets_v1.swz"
WISP_PACKETS = PACKETS.with_name("wisp_packets_v2.swz")
COVERED = [path for path in GOLDEN if covers(ContainerReader.open(path))]
WITH_CUTS = [path for path in COVERED if ContainerReader.open(path).cuts]
needs_wasmtime = pytest.mark.skipif(importlib.util.find_spec("wasmtime") is None, reason="wasmtime is not installed")
needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="Node is not installed")
needs_ziglang = pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="ziglang is not installed")
needs_chromium = pytest.mark.skipif(find_chromium() is None, reason="no Chromium is installed")


@functools.cache
def expected() -> list[tuple[str | None, str | None]]:
    return [in_python(path.read_bytes()) for path in COVERED]


@pytest.fixture(scope="module")
def wasmtime() -> Wasmtime:
    return Wasmtime()


def with_crcs(data: bytes, name: str, change: dict[int, int], **static: object) -> bytes:
    """The file with some bytes of a section or header values changed, so that no CRC-32 of the container tells."""
    from splatwizard_core.coding.container import ContainerWriter

    reader = ContainerReader(data)
    writer = ContainerWriter(reader.method, reader.version, raster=reader.raster)
    writer.static.update({**reader.static, **static})
    for each in reader.sections:
        content = bytearray(reader.section(each))
        if each == name:
            for at, flip in change.items():
                content[at] ^= flip
        writer.add(each, content)
    return writer.to_bytes()


@functools.cache
def tampered() -> list[bytes]:
    """Golden files damaged in each section: as they come from the disk, and behind sound CRCs."""
    return [damaged for name in DAMAGED for damaged in damages((GOLDEN[0].parent / f"{name}.swz").read_bytes())]


DAMAGED = ("3dgs_r3_v1", "3dgs_exact_v1", "c3dgs_v1", "lightgaussian_ranged_v1", "mesongs_v1", "chimerags_uniform16_v1",
           "3dgs_packets_v1", "wisp_v1", "wisp_none_v1", "hac_exact_v1", "hac_half_v2", "hac_plus_v1",
           "hac_plus_tiny_v1", "cat_3dgs_refined_v1", "cat_3dgs_refined_v2", "3dgs_tiles_v1", "3dgs_tiles_v2",
           "compact3dgs_v1", "compact3dgs_one_v1", "compact3dgs_plain_v1", "gsc_quant_v1")  # fmt: skip


def damages(data: bytes) -> list[bytes]:
    found = []
    reader, at = ContainerReader(data), ContainerReader(data).header_bytes
    for name, size in reader.sections.items():
        flipped = bytearray(data)
        flipped[at + size // 2] ^= 0x10
        found += [bytes(flipped), data[: at + size // 2], with_crcs(data, name, {size // 2: 0x10})]
        found += [with_crcs(data, name, {0: 2}), with_crcs(data, name, {size - 1: 0x80})]
        at += size
    flipped = bytearray(data)
    flipped[20] ^= 1
    return [*found, bytes(flipped), data[:9], data[:40], b"", data + b"\0"]


@needs_wasmtime
def test_wasmtime_gives_the_hashes_of_the_python_decoder(wasmtime):
    assert [wasmtime.told(path.read_bytes()) for path in COVERED] == expected()


@needs_node
def test_node_gives_the_hashes_of_the_python_decoder():
    assert in_node(COVERED) == expected()


@needs_node
def test_javascript_gets_the_gaussians_of_the_python_decoder(tmp_path):
    in_node(COVERED, tmp_path)
    for path in COVERED:
        model = decode_model(ContainerReader.open(path), load_plugins())
        if not isinstance(model, GaussianModel):
            compare_live(np.fromfile(tmp_path / path.name, "<f4"), model)
            continue
        model = as_ellipsoids(model)
        sh = torch.cat([model.sh_dc, model.sh_rest], dim=1)
        values = (model.means, model.quats, model.scales, model.opacities, sh)
        wanted = np.concatenate([value.detach().numpy().ravel() for value in values])
        # exp and the sigmoid are those of float64 there, of float32 here; shared opacities pass through a logit.
        np.testing.assert_allclose(np.fromfile(tmp_path / path.name, "<f4"), wanted, rtol=3e-6, atol=1e-6)


@torch.no_grad()
def compare_live(found: np.ndarray, model: SplatModel) -> None:
    """Arrays of a file whose Gaussians depend on the eye, as they are seen from the origin."""
    camera = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, torch.eye(3), torch.zeros(3))
    if isinstance(model, AnchorSplats):
        seen = model.decode(camera, torch.arange(model.num_rows))
    else:
        everything = SimpleNamespace(visible_filter=lambda inputs, _: torch.ones(len(inputs.means), dtype=torch.bool))
        seen = model.gaussians(camera, everything)
        seen = replace(seen, colors=0.5 + SH_C0 * seen.sh.to_dense()[:, 0], sh=None)
    values = (seen.means, seen.quats, seen.scales, seen.opacities, (seen.colors - 0.5) / SH_C0)
    wanted = np.concatenate([value.numpy().ravel() for value in values])
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5)


@needs_chromium
def test_chromium_gives_the_hashes_of_the_python_decoder(tmp_path):
    assert in_chromium(COVERED, tmp_path) == expected()


@needs_chromium
@pytest.mark.parametrize("name", ["plain", "three"])
def test_the_examples_draw_a_file(tmp_path, name):
    with served(tmp_path) as address:
        if name == "three":
            if not THREE.is_dir():
                pytest.skip("three.js is not installed: make test-wasm does")
            (tmp_path / "package" / "examples" / "node_modules").symlink_to(THREE)
        page = f"{address}/package/examples/{name}.html?file=/golden/3dgs_r5_v1.swz"
        with opened(page, tmp_path / "profile") as browser:
            until = time.monotonic() + 30
            while browser.ask("document.documentElement.dataset.state") != "drawn":
                assert time.monotonic() < until, browser.complaints()
                time.sleep(0.05)
            assert browser.ask("document.getElementById('told').textContent") == "48 Gaussians of 3dgs"
            browser.picture(tmp_path / "window.png", whole=False)
    assert np.asarray(Image.open(tmp_path / "window.png").convert("L"))[100:].std() > 1


@needs_wasmtime
def test_a_tampered_file_gives_the_same_reason(wasmtime):
    """But for what zlib and zstd say of a stream in their own words."""
    of_library = re.compile(
        "(?<=: )(a zstd frame is|not a zlib stream|the zlib stream does not hold|a zstd frame does not).*"
    )

    def shortened(told: tuple[str | None, str | None]) -> tuple[str | None, str]:
        return told[0], of_library.sub("", told[1] or "")

    found = [shortened(wasmtime.told(data)) for data in tampered()]
    assert found == [shortened(in_python(data)) for data in tampered()]
    assert len({reason for _, reason in found}) > 50


@needs_node
def test_the_reason_reaches_javascript(tmp_path):
    (tmp_path / "x.swz").write_bytes(tampered()[0])
    assert in_node([tmp_path / "x.swz"]) == [in_python(tampered()[0])]


@needs_wasmtime
@pytest.mark.parametrize("path", WITH_CUTS, ids=lambda path: path.stem)
def test_a_file_with_cuts_is_read_up_to_each_of_them(wasmtime, path):
    data = path.read_bytes()
    reader = ContainerReader(data)
    assert len(reader.cuts) >= 2
    for number, cut in enumerate(reader.cuts, 1):
        wanted = decode_model(ContainerReader(data, prefix=Prefix(packets=number)), load_plugins()).parameter_hash()
        assert wasmtime.told(data, packets=number) == (wanted, None)
        assert wasmtime.told(data[: reader.header_bytes + cut.bytes]) == (wanted, None)
    assert wasmtime.told(data, packets=99)[1] == f"it has {len(reader.cuts)} packets, 99 are asked for"


@needs_wasmtime
@pytest.mark.parametrize("then", [(0,), (2, 0), (2, 3), (3, 3)], ids=str)
def test_a_file_of_wisp_goes_on_behind_its_first_packet(wasmtime, then):
    data = WISP_PACKETS.read_bytes()
    assert wasmtime.told(data, packets=1, then=then) == wasmtime.told(data, packets=then[-1])


@needs_wasmtime
def test_a_damaged_packet_is_named_when_the_file_goes_on(wasmtime):
    data = WISP_PACKETS.read_bytes()
    data = data[:-1] + bytes([data[-1] ^ 1])
    first, whole = wasmtime.told(data, packets=1, then=(0,)), wasmtime.told(data)
    assert first == whole
    assert "CRC-32 does not match" in whole[1]


@needs_node
def test_arrays_that_went_on_are_those_of_the_whole():
    paths = [*WITH_CUTS, COVERED[0]]
    script = SCRIPT.with_name("refined_files.mjs")
    done = subprocess.run(["node", script, *paths], capture_output=True, text=True, check=True)
    wanted = [[[False, True], [True, True]] if path in WITH_CUTS else [[True, True]] for path in paths]
    assert [json.loads(line) for line in done.stdout.splitlines()] == wanted


@needs_node
def test_javascript_is_shown_the_first_cut_before_the_whole():
    done = subprocess.run(["node", SCRIPT, PACKETS, COVERED[0]], capture_output=True, text=True, check=True)
    (_, _, coarse), whole = (json.loads(line) for line in done.stdout.splitlines())
    first = ContainerReader(PACKETS.read_bytes()).static["packets"][0][0]
    assert coarse == first
    assert len(whole) == 2


@needs_wasmtime
def test_a_file_it_does_not_know_is_refused_by_name(wasmtime):
    for path in sorted(set(GOLDEN) - set(COVERED)):
        found, reason = wasmtime.told(path.read_bytes())
        assert found is None
        assert reason.startswith("this decoder does not know the "), path


def rate_points() -> list[bytes]:
    """A file for each rate point of every method that the decoder knows, of the Gaussians of its first golden file."""
    spec = importlib.util.spec_from_file_location("make_golden", GOLDEN[0].parent / "make_golden.py")
    golden = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(golden)
    plugins, found, seen = load_plugins(), [], set()
    for name in (path.stem for path in COVERED):
        if name not in golden.CASES or golden.CASES[name][0] in seen:
            continue
        method, _, values, model = golden.CASES[name]
        seen.add(method)
        for rate in plugins.methods.load(method).RATES:
            golden.CASES[name] = (method, rate, values, model)
            found.append(golden.encoded(name))
    golden.CASES["small"] = ("wisp", "r3", {}, lambda: golden.splats(20, "small"))
    return [*found, golden.encoded("small")]


@needs_wasmtime
def test_every_rate_point_has_the_hash_of_the_python_decoder(wasmtime):
    files = [data for data in rate_points() if covers(ContainerReader(data))]
    assert len({ContainerReader(data).method for data in files}) >= 13
    assert len(files) > 60
    assert [wasmtime.told(data) for data in files] == [in_python(data) for data in files]


@needs_node
def test_decimal_numbers_of_a_header_are_rounded_as_in_python(tmp_path):
    """The root cube of wisp as it stands: means are float64 arithmetic of it, rounded once."""
    plain, paths = (GOLDEN[0].parent / "wisp_none_v1.swz").read_bytes(), []
    random = np.random.default_rng(0)
    for number in range(20):
        low = [float(x) for x in random.uniform(-1, 1, 3) * 10.0 ** random.integers(-18, 18, 3)]
        data = with_crcs(plain, "networks", {}, low=low, edge=float(10.0 ** random.uniform(-9, 9)))
        (tmp_path / f"{number}.swz").write_bytes(data)
        paths.append(tmp_path / f"{number}.swz")
    (tmp_path / "into").mkdir()
    in_node(paths, tmp_path / "into")
    for path in paths:
        means = decode_model(ContainerReader.open(path), load_plugins()).means.detach().numpy()
        assert (np.fromfile(tmp_path / "into" / path.name, "<f4", means.size) == means.ravel()).all()


@needs_wasmtime
def test_too_little_memory_is_told(wasmtime):
    path = ROOT / "tests" / "golden" / "3dgs_classes_v1.swz"
    assert wasmtime.told(path.read_bytes(), memory=3 << 19) == (None, "the decoder has no more memory")


@needs_ziglang
def test_a_build_here_gives_the_same_bytes():
    subprocess.run([sys.executable, ROOT / "tools" / "build_decoder.py", "--check"], check=True)

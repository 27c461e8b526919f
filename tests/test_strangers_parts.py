"""A stranger's parts where ours stand: a method from points that says only how it trains, and an entropy model and a
position codec by name, in a file of ours that a fresh process decodes.
"""

from __future__ import annotations

import json
import shutil

import pytest
from strangers_site import Site

pytestmark = pytest.mark.pipeline

METHOD = """
@hookimpl
def register_methods(registry):
    registry.add("from-points", "sw_points_method:FromPoints", summary="starts from points")
"""
METHOD_TARGET = """
from sw_gaussians.choices import Choosing, CodecChoice
from sw_gaussians.config import GaussianTraining
from sw_gaussians.method import GaussianMethod
from sw_gaussians.stage import ThreeDGSStage

class Config(Choosing, GaussianTraining):
    codec: CodecChoice = CodecChoice(name="gaussians-quantized")

class FromPoints(GaussianMethod):
    name = "from-points"
    Config = Config

    def stages(self):
        return [ThreeDGSStage(self.config)]
"""
PARTS = """
@hookimpl
def register_entropy_models(registry):
    registry.add("zipped", "sw_parts_target:Zipped", summary="one stream of zlib")
    registry.add("zipped-badly", "sw_parts_target:ZippedBadly", summary="loses the sign")

@hookimpl
def register_coders(registry):
    registry.add("plain-points", "sw_parts_target:Points", summary="three integers each", codes="positions")
    registry.add("plain-arrays", "sw_parts_target:Arrays", summary="zlib of all of it", codes="arrays")
    registry.add("no-floats", "sw_parts_target:NoFloats", summary="of integers alone", codes="arrays")
"""
PARTS_TARGET = """
import zlib
import numpy as np
from splatwizard_core.api import BitstreamError
from sw_codecs.positions import morton

class Zipped:
    def bits(self, symbols, context):
        raise NotImplementedError

    def encode(self, symbols, context):
        return zlib.compress(np.ascontiguousarray(symbols, "<i8").tobytes())

    def decode(self, data, context):
        size = 8 * int(np.prod(context))
        found = zlib.decompressobj().decompress(data, size + 1)
        if len(found) != size:
            raise BitstreamError("another size")
        return np.frombuffer(found, "<i8").reshape(context)

class ZippedBadly(Zipped):
    def encode(self, symbols, context):
        return super().encode(abs(symbols), context)

class Points:
    def __init__(self, max_points=1 << 20):
        self.max_points = max_points

    def sort(self, points):
        return np.argsort(morton.encode(points), kind="stable")

    def encode(self, points, bits):
        return points.astype("<i4").tobytes()

    def decode(self, data):
        if len(data) > 12 * self.max_points or len(data) % 12:
            raise BitstreamError("too many points")
        return np.frombuffer(data, "<i4").reshape(-1, 3).astype(np.int64)

class Arrays:
    def encode(self, array):
        return zlib.compress(np.ascontiguousarray(array).tobytes())

    def decode(self, data, dtype, shape):
        size = np.dtype(dtype).itemsize * int(np.prod(shape))
        found = zlib.decompressobj().decompress(data, size + 1)
        if len(found) != size:
            raise BitstreamError("another size")
        return np.frombuffer(found, dtype).reshape(shape)

class NoFloats(Arrays):
    def encode(self, array):
        return super().encode(array.astype(np.int64).astype(array.dtype))
"""
SHORT = ("--scene", "demo:tiny", "--set", "iterations=4", "--json")
CHOSEN = ("--set", "codec.settings.entropy=zipped", "--set", "codec.settings.positions=plain-points")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    site = Site(tmp_path_factory.mktemp("parts"))
    site.install("sw-points", METHOD, sw_points_method=METHOD_TARGET)
    site.install("sw-parts", PARTS, sw_parts_target=PARTS_TARGET)
    return site


@pytest.fixture(scope="module")
def records(site):
    """Our method with our parts, and with the stranger's; his method."""
    ours = ("run", "--method", "3dgs", "--rate", "r3", *SHORT)
    runs = {
        "usual": site.sw(*ours, "--out", "usual"),
        "chosen": site.sw(*ours, *CHOSEN, "--out", "chosen"),
        "points": site.sw("run", "--method", "from-points", *SHORT, *CHOSEN, "--out", "points"),
    }
    return {name: json.loads(done.stdout)["runs"][0]["record"] for name, done in runs.items()}


def file_of(site, name):
    (found,) = (site.folder / name).glob("**/scene.swz")
    return found


@pytest.mark.parametrize("name", ["chosen", "points"])
def test_parts_by_name_write_a_file_that_a_fresh_process_decodes(site, records, name):
    file = str(file_of(site, name))
    info, decoded = (
        json.loads(done.stdout) for done in site.sw_each([[c, file, "--json"] for c in ("info", "decode")])
    )
    assert info["static"]["entropy"] == "zipped"
    assert info["static"]["positions"] == "plain-points"
    assert info["requires"]["sw-parts"] == "0.1"
    assert decoded["digest"] == records[name]["file"]["digest"]


def test_the_usual_parts_are_not_named(site, records):
    static = json.loads(site.sw("info", file_of(site, "usual"), "--json").stdout)["static"]
    assert not {"entropy", "positions"} & static.keys()
    assert records["usual"]["file"]["digest"] == records["chosen"]["file"]["digest"]  # the parts lose nothing
    assert records["usual"]["file"]["bytes"] != records["chosen"]["file"]["bytes"]


def test_a_part_that_is_not_there_is_told_with_its_package(site, records, tmp_path):
    nobody = Site(tmp_path)
    shutil.copy(file_of(site, "chosen"), tmp_path / "scene.swz")
    done = nobody.sw("decode", "scene.swz", check=False)
    assert done.returncode == 2
    assert "needs coder 'plain-points', which is not installed: " in done.stderr
    assert "pip install 'sw-parts>=0.1' (the package that the file names)" in done.stderr


REFUSED = [
    ("entropy", "zippd", "no entropy model is called 'zippd'; did you mean 'zipped'?"),
    ("entropy", "categorical", "entropy model 'categorical' of sw-codecs"),
    ("entropy", "zipped-badly", "entropy model 'zipped-badly' of sw-parts 0.1 cannot serve as codec.settings.entropy"),
    ("positions", "zipped", "no coder is called 'zipped'"),
    ("positions", "huffman", "coder 'huffman' does not code positions"),
]


def test_a_part_that_cannot_serve_is_told_before_anything_is_trained(site):
    words = ["train", "--method", "3dgs", "--rate", "r3", *SHORT[:-1], "--out", "none"]
    told = site.sw_each([[*words, "--set", f"codec.settings.{part}={name}"] for part, name, _ in REFUSED])
    for (_, name, said), done in zip(REFUSED, told, strict=True):
        assert done.status == 2, name
        assert said in done.stderr
    assert not list((site.folder / "none").glob("**/checkpoints"))


VECTORS = {"codec.settings.entropy": "zipped", "codec.settings.arrays": "plain-arrays"}
IN_FILES = {
    "lightgaussian": (("--method", "lightgaussian"), VECTORS),
    "gaussians-zstd": (
        ("--method", "trimming-the-fat", "--set", "codec=gaussians-zstd"),
        {"codec.settings.means": "plain-arrays", "codec.settings.arrays": "plain-arrays"},
    ),
    "chimerags": (
        ("--method", "chimerags", "--set", "distill.iterations=4", "--set", "train.method=3dgs"),
        {**VECTORS, "arrays": "plain-arrays"},
    ),
}


@pytest.mark.parametrize("method", IN_FILES)
def test_files_of_other_methods_take_parts_by_name_too(site, method):
    words, parts = IN_FILES[method]
    small = () if method == "gaussians-zstd" else ("--set", "codec.settings.iterations=3")
    usual = json.loads(site.sw("run", *words, *small, *SHORT, "--out", "others").stdout)["runs"][0]
    chosen = [word for key, name in parts.items() for word in ("--set", f"{key}={name}")]
    badly = {"codec.settings.entropy": "zipped-badly", "codec.settings.means": "no-floats", "arrays": "no-floats"}
    badly = {key: name for key, name in badly.items() if key in parts}
    encode, same = ["encode", usual["directory"]], f"{usual['directory']}/scene.swz"
    _, *shown, decoded = site.sw_each([
        [*encode, *chosen, "--out", "chosen.swz", "--no-psnr"],
        *(["info", file, "--json"] for file in ("chosen.swz", same)),
        *([*encode, "--set", f"{key}={name}", "--out", "no.swz"] for key, name in badly.items()),
        ["decode", "chosen.swz", "--json"],
    ])  # fmt: skip
    info, plain = (json.loads(done.stdout) for done in shown[:2])
    assert info["requires"]["sw-parts"] == "0.1"
    assert info["static"]["arrays"] == "plain-arrays"
    assert "sw-parts" not in plain["requires"]
    assert json.loads(decoded.stdout)["digest"] == usual["record"]["file"]["digest"]  # the parts lose nothing
    for (key, name), done in zip(badly.items(), shown[2:], strict=True):
        assert done.status == 2
        assert f"'{name}' of sw-parts 0.1 cannot serve as {key}" in done.stderr

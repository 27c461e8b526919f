"""The WebAssembly modules that are shipped are those of the sources that lie beside it."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import subprocess
import zlib
from pathlib import Path

import pytest
import sw_view

from splatwizard_core.coding.container import ContainerReader, ContainerWriter

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests" / "golden"
FOLDER = Path(sw_view.__file__).parent / "splatwizard-decoder"
BUILT = json.loads((FOLDER / "build.json").read_text())
AGAIN = "run `pip install ziglang==0.17.1 && python tools/build_decoder.py`"


def builder():
    spec = importlib.util.spec_from_file_location("build_decoder", ROOT / "tools" / "build_decoder.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_shipped_modules_are_built_from_these_sources():
    assert list(BUILT) == list(builder().MODULES)
    for name, built in BUILT.items():
        assert built["sources"] == builder().sources_hash(name), AGAIN
        module = (FOLDER / name).read_bytes()
        assert (built["bytes"], built["sha256"]) == (len(module), hashlib.sha256(module).hexdigest()), AGAIN


def test_it_has_the_tables_of_sw_codecs():
    assert zlib.decompress((FOLDER / "exact_tables.zlib").read_bytes()) == (ROOT / builder().TABLES).read_bytes()


def test_it_is_small():
    assert all(each["bytes"] <= 150_000 for each in BUILT.values())
    assert sum(path.stat().st_size for path in FOLDER.glob("*.js")) <= 40_000


def test_its_package_has_the_version_of_sw_view():
    assert json.loads((FOLDER / "package.json").read_text())["version"] == sw_view.__version__


@pytest.mark.skipif(shutil.which("node") is None, reason="Node is not installed")
def test_what_is_no_file_and_what_claims_too_much_is_told_in_a_second(tmp_path):
    """Of each module one file, as it stands on the disk: cut, empty, and with a count that its bytes cannot hold."""
    paths = []
    for name in ("3dgs_r3_v1", "compact3dgs_v1", "hac_half_v2"):
        data = (GOLDEN / f"{name}.swz").read_bytes()
        reader = ContainerReader(data)
        writer = ContainerWriter(reader.method, reader.version, raster=reader.raster)
        writer.static.update({**reader.static, "num_gaussians": 1 << 31})
        if "num_anchors" in reader.static:
            writer.static["num_anchors"] = 1 << 31
        for section in reader.sections:
            writer.add(section, reader.section(section))
        for number, content in enumerate((data[:100], data[:-1], b"", writer.to_bytes())):
            paths.append(tmp_path / f"{name}{number}.swz")
            paths[-1].write_bytes(content)
    script = Path(__file__).with_name("decode_files.mjs")
    done = subprocess.run(["node", script, *paths], capture_output=True, text=True, check=True, timeout=60)
    told = [json.loads(line)[1] for line in done.stdout.splitlines()]
    assert [reason.split(" ")[0] for reason in told] == ["the", "section", "the", "claims"] * 3
    assert told[3].startswith("claims a model of 2,147,483,648 Gaussians of ")
    assert told[7].startswith("claims 2,147,483,648 Gaussians and a grid of ")
    assert told[11].startswith("claims a model of 2,147,483,648 anchors of ")

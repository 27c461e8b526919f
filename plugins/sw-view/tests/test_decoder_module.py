"""The WebAssembly modules that are shipped are those of the sources that lie beside it."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import zlib
from pathlib import Path

import sw_view

ROOT = Path(__file__).parents[3]
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
    assert BUILT["decoder.wasm"]["bytes"] <= 150_000
    assert BUILT["anchors.wasm"]["bytes"] <= 150_000
    assert sum(path.stat().st_size for path in FOLDER.glob("*.js")) <= 40_000


def test_its_package_has_the_version_of_sw_view():
    assert json.loads((FOLDER / "package.json").read_text())["version"] == sw_view.__version__

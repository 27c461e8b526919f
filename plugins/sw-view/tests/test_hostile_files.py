"""Hostile files in the WebAssembly decoder: a reason for each, in bounded memory, and never a trap without one.

Checksums would stand in the way: they are 0 in files and modules alike (`swz_fuzzer.blind`, -DSWZ_BLIND).
"""

from __future__ import annotations

import importlib.util
import os
import random
import subprocess
import sys
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from sw_view.coded_file import covers, module_of
from swz_fuzzer import blind

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from sw_codecs.entropy.exact_tables import exact_tables

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests" / "golden"
MEMORY = 256 << 20
SECONDS = 5
"""Until a module is interrupted: a reason takes one at most on a core of its own."""
FLIPS = int(os.environ.get("FUZZ", "40"))
"""Damaged files of each case; FUZZ=2000 for a hundred thousand of them, SEED for others."""
VALUES = (-1, 0, 65535, 1 << 31, 1 << 62, 1e308, None, "x", [], {}, [0, 0, 0], [1 << 40] * 3, [4096] * 32)
needs_engines = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("wasmtime", "ziglang")), reason="needs wasmtime and ziglang"
)


def loaded(name: str, path: Path):
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Blind:
    """The modules without checksums in wasmtime."""

    def __init__(self, folder: Path) -> None:
        import wasmtime

        self.api, config = wasmtime, wasmtime.Config()
        config.epoch_interruption = True
        self.engine, builder, self.modules = wasmtime.Engine(config), loaded("b", ROOT / "tools/build_decoder.py"), {}
        for name in builder.MODULES:
            sources = [*builder.FLAGS, "-DSWZ_BLIND", *map(str, builder.sources(name))]
            subprocess.run(
                [sys.executable, "-m", "ziglang", "c++", *sources, "-o", folder / name], cwd=ROOT, check=True
            )
            self.modules[name] = wasmtime.Module.from_file(self.engine, str(folder / name))
        self.tables = zlib.compress((ROOT / builder.TABLES).read_bytes()[:-4] + bytes(4))

    def told(self, data: bytes, name: str, first: int = 0) -> str:
        """The reason, or "" for a file that is decoded; so many packets `first`, then the rest."""
        store = self.api.Store(self.engine)
        store.set_limits(memory_size=MEMORY)
        store.set_epoch_deadline(2)
        exports = self.api.Instance(store, self.modules[name], []).exports(store)
        exports["_initialize"](store)
        timer = threading.Timer(SECONDS, lambda: [self.engine.increment_epoch() for _ in range(2)])
        timer.start()
        try:
            exports["memory"].write(store, data, exports["swz_input"](store, len(data)))
            exports["memory"].write(store, self.tables, exports["swz_tables"](store, len(self.tables)))
            exports["swz_decode"](store, first)
            if first:
                exports["swz_go_on"](store, 0)
        except self.api.Trap as trap:
            at = exports["swz_refusal"](store)
            reason = bytes(exports["memory"].read(store, at, at + 1024)).partition(b"\0")[0].decode(errors="replace")
            return reason or f"NO REASON: {trap}"
        finally:
            timer.cancel()
        return ""


@pytest.fixture(scope="module")
def modules(tmp_path_factory) -> Blind:
    return Blind(tmp_path_factory.mktemp("blind"))


@pytest.fixture(scope="module")
def files() -> Iterator[dict[str, tuple[bytes, str]]]:
    """Each golden case anew, with checksums of 0, and the module that knows it."""
    golden, found, crc = loaded("make_golden", GOLDEN / "make_golden.py"), {}, exact_tables().crc
    object.__setattr__(exact_tables(), "crc", 0)
    try:
        with blind():
            for name in golden.CASES:
                data = golden.encoded(name)
                if covers(reader := ContainerReader(data)):
                    found[name] = data, module_of(reader)
            yield found
    finally:
        object.__setattr__(exact_tables(), "crc", crc)


@pytest.mark.slow
@needs_engines
def test_no_flipped_byte_traps_without_a_reason(modules, files):
    draw, reasons = random.Random(os.environ.get("SEED", "0")), set()
    for name, (data, module) in files.items():
        assert modules.told(data, module) == "", name
        begin, has_cuts = (reader := ContainerReader(data)).header_bytes, bool(reader.cuts)
        for _ in range(FLIPS if begin < len(data) else 0):
            damaged = bytearray(data)
            for _ in range(draw.choice((1, 1, 2, 4))):
                at = draw.randrange(begin, len(data))
                damaged[at] = draw.choice((damaged[at] ^ 1 << draw.randrange(8), 0, 255, draw.randrange(256)))
            reason = modules.told(bytes(damaged), module, draw.randrange(2) if has_cuts else 0)
            assert not reason.startswith("NO REASON"), (name, reason)
            reasons.add(reason)
    assert len(reasons) > 200


@pytest.mark.slow
@needs_engines
def test_no_header_value_traps_or_takes_the_memory(modules, files):
    reasons = set()
    for name, (data, module) in files.items():
        reader = ContainerReader(data)
        for key in reader.static:
            for value in VALUES:
                writer = ContainerWriter(reader.method, reader.version, raster=reader.raster)
                writer.static.update({**reader.static, key: value})
                for section in reader.sections:
                    writer.add(section, reader.section(section))
                reason = modules.told(writer.to_bytes(), module)
                assert not reason.startswith("NO REASON"), (name, key, value, reason)
                assert "no more memory" not in reason, (name, key, value)
                reasons.add(reason)
    assert len(reasons) > 100

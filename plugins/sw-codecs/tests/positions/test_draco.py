"""draco: sets and multisets of points, size, damage, and data that make the library run away."""

import resource
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest

from splatwizard_core.errors import BitstreamError, CapabilityError
from splatwizard_core.plugins import load_plugins
from sw_codecs.bits.packing import write_varint
from sw_codecs.positions import draco, morton
from sw_codecs.positions.draco import Draco
from sw_codecs.positions.octree import Octree

GOLDEN = Path(__file__).parents[1] / "golden" / "draco_v1.bin"  # written once, never rewritten
needs_draco = pytest.mark.skipif(draco.unavailable() is not None, reason=f"DracoPy is {draco.unavailable()}")


def surface(n, bits=16):
    r = np.random.default_rng(0)
    u = r.uniform(size=(n, 2)) * 2 * np.pi
    torus = np.stack(
        [(2 + np.cos(u[:, 1])) * np.cos(u[:, 0]), (2 + np.cos(u[:, 1])) * np.sin(u[:, 0]), np.sin(u[:, 1])], 1
    )
    points = ((torus + 3) / 6 * ((1 << bits) - 1)).astype(np.int64)
    return points[morton.sort(points)]


def clouds():
    r = np.random.default_rng(1)
    flat = r.integers(0, 1 << 16, (500, 3))
    flat[:, 2] = 77
    return {
        "surface": (surface(5000), 16),
        "planar": (flat, 16),
        "duplicates": (r.integers(0, 8, (3000, 3)), 10),
        "single": (np.array([[1, 2, 3]]), 21),
        "one-point-many-times": (np.full((500, 3), 9), 4),
        "one-bit": (r.integers(0, 2, (20, 3)), 1),
        "wide": (r.integers(0, 1 << 21, (3000, 3)), 21),
        "corners": (np.array([[0, 0, 0], [2**21 - 1] * 3]), 21),
        "empty": (np.empty((0, 3), int), 16),
    }


@needs_draco
@pytest.mark.parametrize("name", list(clouds()))
def test_clouds_come_back_in_morton_order(name):
    points, bits = clouds()[name]
    points = points[morton.sort(points)]
    found = Draco().decode(Draco().encode(points, bits))
    assert found.dtype == np.int64
    assert np.array_equal(found, points)


@needs_draco
def test_a_file_of_version_1_still_decodes():
    i = np.arange(300)
    points = np.stack([i * i % 977, i * 7 % 512, i // 3], 1)
    points = np.concatenate([points, points[::17]])
    assert np.array_equal(Draco().decode(GOLDEN.read_bytes()), points[morton.sort(points)])


@needs_draco
def test_a_surface_takes_about_what_the_octree_takes():
    points = surface(20_000)
    assert len(Draco().encode(points, 16)) < 1.1 * len(Octree().encode(points, 16))


@needs_draco
def test_damage_is_found_mostly_before_draco_sees_it(monkeypatch, assert_survives_damage):
    points = surface(60)
    points[5] = points[4]
    data = Draco().encode(points, 16)
    real = subprocess.run
    calls = []

    def counted(*arguments, **options):
        calls.append(arguments)
        return real(*arguments, **options)

    monkeypatch.setattr(subprocess, "run", counted)
    assert_survives_damage(data, Draco().decode, points, masks=(0x01, 0x80))
    assert len(calls) < 60  # only what does not concern the library's own bytes gets that far


def forged(file, count):
    head = bytes([draco.VERSION, 16]) + bytes(4) + write_varint(count) + write_varint(count)
    return head + write_varint(len(file)) + zlib.crc32(file).to_bytes(4, "little") + file + write_varint(0)


@needs_draco
def test_data_made_to_harm_the_library_are_refused(monkeypatch):
    """Checksums in order, and bytes of the library's own changed: some of these crash it, hang it or flood it."""
    monkeypatch.setattr(draco, "SECONDS", 1)
    points = surface(300)
    import DracoPy

    file = DracoPy.encode(points.astype(np.float32), quantization_bits=16, compression_level=7,
                          quantization_range=65535, quantization_origin=[0, 0, 0])  # fmt: skip
    r = np.random.default_rng(2)
    for _ in range(8):
        changed = bytearray(file)
        for _ in range(2):
            changed[int(r.integers(draco.HEAD, 60))] = int(r.integers(256))
        with pytest.raises(BitstreamError):
            Draco().decode(forged(bytes(changed), 300))
    with pytest.raises(BitstreamError, match="no Draco file of 299"):
        Draco().decode(forged(file, 299))
    with pytest.raises(BitstreamError, match="CRC-32"):
        Draco().decode(forged(file, 300))  # well formed, but not the points that were announced


def run_away(tmp_path, monkeypatch, body):
    program = tmp_path / "program.py"
    program.write_text(f"import resource, sys\nresource.setrlimit(resource.RLIMIT_CPU, (1, 1))\n{body}")
    monkeypatch.setattr(draco, "PROCESS", program)
    file = b"DRACO" + bytes(6) + (2).to_bytes(4, "little")
    started = time.monotonic()
    with pytest.raises(BitstreamError, match="Draco"):
        Draco().decode(forged(file, 2))
    return time.monotonic() - started


@needs_draco
@pytest.mark.parametrize(
    "body", ["while True: pass", "import os; os.abort()", "sys.exit('no')", "print('too short')", "bytes(1 << 60)"]
)
def test_whatever_the_process_does_ends_in_a_bitstream_error(tmp_path, monkeypatch, body):
    assert run_away(tmp_path, monkeypatch, body) < 30


@needs_draco
def test_the_process_keeps_to_its_limits():
    import DracoPy

    file = DracoPy.encode(surface(50_000).astype(np.float32), quantization_bits=16)
    for limits, says in (((1 << 24, 5, 50_000), ""), ((1 << 30, 5, 49_999), "does not hold 49,999")):
        child = subprocess.run(
            [sys.executable, "-I", str(draco.PROCESS), *map(str, limits)], input=file, capture_output=True
        )
        assert child.returncode
        assert says in child.stderr.decode()
    assert resource.getrlimit(resource.RLIMIT_CPU)[0] == resource.RLIM_INFINITY


def test_without_the_package_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    for attempt in (lambda: Draco().encode(surface(3), 16), lambda: Draco().decode(b"")):
        with pytest.raises(CapabilityError, match=r"pip install 'sw-codecs\[draco\]'"):
            attempt()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert draco.unavailable() == "not installed: pip install 'sw-codecs[draco]'"
    assert load_plugins().coders.entry("draco").declared["available"] == "sw_codecs.positions.draco:unavailable"

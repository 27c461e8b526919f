"""The .swz container: round trips, and what it says about damaged, truncated and hostile files."""

import json
import os
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.coding import container
from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.coding.limits import EXPANSION_VARIABLE, decoded_limit
from splatwizard_core.coding.requirements import Requirement
from splatwizard_core.errors import (
    BitstreamError,
    ConfigError,
    DiskFullError,
    PluginError,
    SceneError,
    SplatwizardError,
)

DTYPES = ["bool", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"]


def small_file():
    writer = ContainerWriter("3dgs", 2, raster={"antialias": False, "sh_degree": 3})
    writer.static.update({"count": 4, "extent": 1.5, "mode": "raw"})
    writer.add("positions", b"abcdefgh")
    writer.add("empty", b"")
    writer.add_array("bounds", np.arange(6, dtype=np.float32).reshape(2, 3))
    return writer


def rebuilt(header, payload=b"", *, raw=None, version=1):
    """A file with a valid CRC around whatever header a stranger thinks up."""
    body = json.dumps(header).encode() if raw is None else raw
    return struct.pack("<4sHI", b"SPWZ", version, len(body)) + body + struct.pack("<I", zlib.crc32(body)) + payload


def plain_header(**changes):
    return {"method": "m", "method_version": 1, "raster": {}, "static": {}, "sections": [], **changes}


def test_round_trip_of_everything_the_writer_takes():
    reader = ContainerReader(small_file().to_bytes())
    assert (reader.method, reader.version) == ("3dgs", 2)
    assert reader.raster == {"antialias": False, "sh_degree": 3}
    assert reader.static == {"count": 4, "extent": 1.5, "mode": "raw"}
    assert reader.section("positions") == b"abcdefgh"
    assert reader.section("empty") == b""
    found = reader.array("bounds", dtype="f4", shape=(2, 3))
    assert found.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert found.flags.writeable


def test_breakdown_sums_to_the_file_size():
    data = small_file().to_bytes()
    reader = ContainerReader(data)
    assert sum(reader.summary()["bytes"].values()) == reader.size == len(data)
    assert reader.sections == small_file().sections
    json.dumps(reader.summary())


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63) + 1, 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None)
@given(
    static=st.dictionaries(st.text(max_size=6), json_values, max_size=4),
    parts=st.dictionaries(
        st.from_regex(r"[a-z0-9_][a-z0-9_./-]{0,20}", fullmatch=True), st.binary(max_size=40), max_size=5
    ),
)
def test_any_static_values_and_sections_come_back(static, parts):
    parts.pop("header", None)
    writer = ContainerWriter("m", 0)
    writer.static.update(static)
    for name, data in parts.items():
        writer.add(name, data)
    reader = ContainerReader(writer.to_bytes())
    assert reader.static == static
    assert {name: reader.section(name) for name in reader.sections} == parts


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(DTYPES), st.lists(st.integers(0, 4), max_size=4), st.integers(0, 2**32 - 1))
def test_arrays_come_back_bit_for_bit(dtype, shape, seed):
    size = int(np.prod(shape, dtype=int)) * np.dtype(dtype).itemsize
    raw = np.random.default_rng(seed).integers(0, 2 if dtype == "bool" else 256, size, dtype=np.uint8)
    array = np.frombuffer(raw.tobytes(), dtype).reshape(shape)
    writer = ContainerWriter("m", 1)
    writer.add_array("a", array)
    writer.add_array("swapped", array.astype(array.dtype.newbyteorder(">")))
    writer.add_array("strided", array.T)
    reader = ContainerReader(writer.to_bytes())
    assert reader.array("a", dtype=dtype, shape=shape).tobytes() == array.tobytes()
    assert reader.section("swapped") == reader.section("a")
    assert reader.array("strided", dtype=dtype, ndim=len(shape)).tobytes() == array.T.tobytes()


def test_array_checks_name_the_section_and_what_is_wrong():
    reader = ContainerReader(small_file().to_bytes(), "x.swz")
    for wrong in (
        {"dtype": "f8"},
        {"dtype": "f4", "ndim": 1},
        {"dtype": "f4", "shape": (2, 4)},
        {"dtype": "f4", "shape": (6,)},
    ):
        with pytest.raises(BitstreamError, match=r"x\.swz: section 'bounds'"):
            reader.array("bounds", **wrong)
    assert reader.array("bounds", dtype="f4", shape=(None, 3)).shape == (2, 3)
    writer = ContainerWriter("m", 1)
    writer.add_array("a", np.array([1.0, np.nan]))
    with pytest.raises(BitstreamError, match="not finite"):
        ContainerReader(writer.to_bytes()).array("a", dtype="f8", ndim=1, finite=True)


@pytest.mark.parametrize(
    "section",
    [
        b"",
        b"\x0a",
        b"\x00\x00",
        b"\x63\x01\x00\x00\x00\x00",
        b"\x0a\x09",
        b"\x0a\xff" + b"\xff" * 2000,
        struct.pack("<BBI", 10, 1, 2**32 - 1),
        struct.pack("<BB3I", 10, 3, 0, 2**32 - 1, 2**32 - 1),
        struct.pack("<BBI", 12, 1, 1) + b"\x02",
        struct.pack("<BBI", 10, 1, 1) + b"\x00" * 5,
    ],
)
def test_hostile_array_headers_are_refused(section):
    writer = ContainerWriter("m", 1)
    writer.add("a", section)
    with pytest.raises(BitstreamError, match="section 'a'"):
        ContainerReader(writer.to_bytes()).array("a", dtype="f4")


def test_object_arrays_are_never_stored():
    with pytest.raises(ValueError, match="dtype object"):
        ContainerWriter("m", 1).add_array("a", np.array([{}]))


def test_every_truncation_is_refused():
    data = small_file().to_bytes()
    for length in range(len(data)):
        with pytest.raises(BitstreamError):
            ContainerReader(data[:length])
    with pytest.raises(BitstreamError, match="3 bytes follow"):
        ContainerReader(data + b"xyz")


def test_an_empty_file_is_called_empty(tmp_path):
    (tmp_path / "none.swz").touch()
    with pytest.raises(BitstreamError, match=r"none\.swz: the file is empty$"):
        ContainerReader.open(tmp_path / "none.swz")


def test_truncation_names_the_section_and_both_lengths():
    data = small_file().to_bytes()
    with pytest.raises(
        BitstreamError, match=r"garden\.swz: section 'bounds': is 30 bytes, header says 34: .*truncated"
    ) as e:
        ContainerReader(data[:-4], "garden.swz")
    assert e.value.section == "bounds"


def test_every_flipped_bit_is_refused():
    data = bytearray(small_file().to_bytes())
    for i in range(len(data)):
        for bit in range(8):
            data[i] ^= 1 << bit
            with pytest.raises(BitstreamError):
                ContainerReader(bytes(data))
            data[i] ^= 1 << bit


def test_newer_version_says_what_to_upgrade():
    with pytest.raises(BitstreamError, match="pip install --upgrade splatwizard-core"):
        ContainerReader(rebuilt(plain_header(), version=container.VERSION + 1))


@pytest.mark.parametrize(
    ("raw", "reason"),
    [
        (b"{", "JSON"),
        (b"\xff\xfe", "JSON"),
        (b"[1]", "exactly"),
        (b"[" * 200_000, "nested"),
        (b"[" * 500 + b"]" * 500, "nested"),
        (b'{"a":NaN}', "finite"),
        (b'{"a":1e999}', "finite"),
        (b'{"a":1,"a":2}', "twice"),
        (b'{"a":' + b"9" * 5000 + b"}", "64 bits"),
        (b'{"a":"\\ud800"}', "surrogate"),
        (b'{"method":"m"}', "exactly"),
        (json.dumps(plain_header(extra=1)).encode(), "exactly"),
        (json.dumps(plain_header(method=3)).encode(), "type str"),
        (json.dumps(plain_header(method_version=True)).encode(), "type int"),
        (json.dumps(plain_header(method="../m")).encode(), "valid"),
        (json.dumps(plain_header(sections={})).encode(), "type list"),
    ],
)
def test_hostile_headers_are_refused_with_the_reason(raw, reason):
    with pytest.raises(BitstreamError, match=reason):
        ContainerReader(rebuilt(None, raw=raw))


def test_the_memory_of_a_header_grows_with_its_length_only():
    # A long key over a long list: its name must not be repeated for each element.
    data = rebuilt(plain_header(static={"k" * 60_000: [0] * 5000}))
    tracemalloc.start()
    ContainerReader(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 * len(data)


CRC_A = zlib.crc32(b"aaaa")


@pytest.mark.parametrize(
    "table",
    [
        [["a", 0, 2**62, CRC_A]],
        [["a", 1, 3, CRC_A]],
        [["a", -4, 4, CRC_A]],
        [["a", 0, -1, CRC_A]],
        [["a", 0, 4.0, CRC_A]],
        [["a", 0, True, CRC_A]],
        [["a", 0, 4]],
        ["a"],
        [[1, 0, 4, CRC_A]],
        [["../a", 0, 4, CRC_A]],
        [["", 0, 4, CRC_A]],
        [["header", 0, 4, CRC_A]],
        [["a", 0, 4, CRC_A], ["a", 4, 0, 0]],
        [["a", 0, 4, CRC_A], ["b", 0, 4, CRC_A]],
        [["a", 0, 4, 0]],
        [["a", 0, 4, "x"]],
        [],
        [["a", 0, 4, CRC_A]] + [[f"s{i}", 4, 0, 0] for i in range(5000)],
    ],
)
def test_hostile_section_tables_are_refused(table):
    with pytest.raises(BitstreamError):
        ContainerReader(rebuilt(plain_header(sections=table), b"aaaa"))


def test_a_huge_header_length_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "huge.swz"
    path.write_bytes(struct.pack("<4sHI", b"SPWZ", 1, 2**32 - 1))
    with pytest.raises(BitstreamError, match="4,294,967,295"):
        ContainerReader.open(path)


@pytest.mark.parametrize("data", [b"", b"S", b"ply\nformat", b"PK\x03\x04" + bytes(30), b"\x80\x04N."])
def test_other_files_are_refused(tmp_path, data):
    path = tmp_path / "other.swz"
    path.write_bytes(data)
    with pytest.raises(BitstreamError, match=r"other\.swz"):
        ContainerReader.open(path)


def test_an_opened_file_is_in_memory_once(tmp_path):
    writer = ContainerWriter("m", 1)
    for i in range(4):
        writer.add(f"s{i}", bytes(1 << 20))
    size = writer.write(tmp_path / "x.swz")
    tracemalloc.start()
    reader = ContainerReader.open(tmp_path / "x.swz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert reader.size == size
    assert peak < 1.1 * size


def test_what_decoding_requires_is_stated_once():
    writer = ContainerWriter("toy", 1)
    for name in ("columns", "octree", "columns"):
        writer.require("entropy model" if name == "columns" else "coder", name)
    assert writer.required == [("entropy model", "columns"), ("coder", "octree")]
    assert writer.requires == []


@pytest.mark.parametrize(
    ("static", "expected"),
    [
        ({}, None),
        ({"made_on": {"device": "cpu AVX2", "torch": "2.13.0"}}, "device cpu AVX2, torch 2.13.0"),
        ({"made_on": 3}, "?"),
    ],
)
def test_a_file_says_on_which_machine_alone_it_decodes(static, expected):
    writer = ContainerWriter("toy", 1)
    writer.static.update(static)
    assert ContainerReader(writer.to_bytes()).made_on == expected


def test_what_a_file_may_stand_for_is_bounded_by_its_size():
    writer = small_file()
    writer.static["junk"] = ["x" * 60_000]
    most = decoded_limit(sum(writer.sections.values()))
    reader = ContainerReader(writer.to_bytes())
    assert reader.size > 60_000
    for allow in (reader.allow, writer.allow):  # the header does not count
        allow(most, "a model")
        with pytest.raises(SplatwizardError, match="a model of"):
            allow(most + 1, "a model")


def test_who_trusts_a_file_may_raise_its_limit(monkeypatch):
    reader = ContainerReader(small_file().to_bytes())
    with pytest.raises(BitstreamError, match=EXPANSION_VARIABLE) as caught:
        reader.allow(1 << 30, "a model")
    monkeypatch.setenv(EXPANSION_VARIABLE, str(caught.value).rpartition("=")[2])
    reader.allow(1 << 30, "a model")
    for bad in ("much", "-1", "9" * 5000):
        monkeypatch.setenv(EXPANSION_VARIABLE, bad)
        with pytest.raises(ConfigError, match="must be a number of bytes") as refused:
            reader.allow(1, "a model")
        assert len(str(refused.value)) < 200


def test_missing_files_and_folders_are_bitstream_errors(tmp_path):
    for path in (tmp_path, tmp_path / "nothing.swz"):
        with pytest.raises(BitstreamError, match="no such file"):
            ContainerReader.open(path)


def test_a_path_that_the_system_refuses_is_a_bitstream_error():
    with pytest.raises(BitstreamError, match="cannot be read: File name too long"):
        ContainerReader.open("x" * 5000)


def test_write_replaces_the_file_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "scene.swz"
    path.write_bytes(b"old")
    assert small_file().write(path) == path.stat().st_size == ContainerReader.open(path).size
    assert os.listdir(tmp_path) == ["scene.swz"]


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "scene.swz"
    path.write_bytes(b"old")

    def no_space(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", no_space)
    with pytest.raises(DiskFullError, match="disk is full"):
        small_file().write(path)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["scene.swz"]


@pytest.mark.parametrize("value", [float("nan"), {1: 2}, b"bytes", {1, 2}, 2**64, np.float32(1), "\ud800"])
def test_static_takes_json_data_only(value):
    writer = ContainerWriter("m", 1)
    writer.static["a"] = {"b": [value]}
    with pytest.raises(ValueError, match=r"static\.a\.b\[0\]"):
        writer.to_bytes()


def test_section_names_are_checked():
    writer = ContainerWriter("m", 1)
    writer.add("a", b"")
    for name in ("a", "", "header", "a b", "/a", "x" * 65):
        with pytest.raises(ValueError):
            writer.add(name, b"")


def test_what_fails_while_decoding_is_blamed_on_the_section():
    reader = ContainerReader(small_file().to_bytes(), "x.swz")
    for error in (BitstreamError("broken"), ValueError("broken"), IndexError("broken"), OverflowError("broken")):
        with (
            pytest.raises(BitstreamError, match=r"x\.swz: section 'positions': .*broken") as caught,
            reader.decoding("positions"),
        ):
            raise error
        assert caught.value.section == "positions"
    with pytest.raises(BitstreamError, match="section 'nothing': is missing"):
        reader.section("nothing")


def test_static_values_are_checked_when_asked_for():
    reader = ContainerReader(small_file().to_bytes())
    assert reader.integer("count", low=0, high=4) == 4
    assert reader.number("extent", low=0, high=2) == 1.5
    assert reader.text("mode", choices=["raw", "packed"]) == "raw"
    for call in (
        lambda: reader.integer("count", low=5, high=9),
        lambda: reader.integer("extent", low=0, high=9),
        lambda: reader.integer("nothing", low=0, high=9),
        lambda: reader.number("mode", low=0, high=9),
        lambda: reader.text("mode", choices=["packed"]),
    ):
        with pytest.raises(BitstreamError, match="header value"):
            call()


def test_a_name_that_the_file_requires_is_a_missing_part_and_not_damage():
    writer = ContainerWriter("m", 1)
    writer.static = {"codec": "martian", "mode": "odd"}
    writer.requires = [Requirement("sw-martian", "1.2", (("coder", "martian"),))]
    reader = ContainerReader(writer.to_bytes(), "f.swz")
    with pytest.raises(PluginError, match="must be one of gaussians-exact") as info:
        reader.text("codec", choices=["gaussians-exact"])
    assert (info.value.kind, info.value.name) == ("coder", "martian")
    with pytest.raises(BitstreamError, match="must be one of plain"):
        reader.text("mode", choices=["plain"])


def test_the_golden_file_of_version_1_reads_as_ever():
    # Written once by `small_file().write(...)`; later versions must read it, and it is never rewritten.
    reader = ContainerReader.open(Path(__file__).parent / "golden" / "container_v1.swz")
    expected = ContainerReader(small_file().to_bytes())
    assert (reader.method, reader.version, reader.raster, reader.static) == (
        "3dgs",
        2,
        expected.raster,
        expected.static,
    )
    assert {name: reader.section(name) for name in reader.sections} == {
        name: expected.section(name) for name in expected.sections
    }


def test_the_layout_is_the_documented_one():
    # Taken apart with nothing but docs/bitstream.md.
    data = small_file().to_bytes()
    assert data[:6] == b"SPWZ\x01\x00"
    length = int.from_bytes(data[6:10], "little")
    header = json.loads(data[10 : 10 + length])
    assert zlib.crc32(data[10 : 10 + length]) == int.from_bytes(data[10 + length : 14 + length], "little")
    assert list(header) == ["method", "method_version", "raster", "static", "sections"]
    body = data[14 + length :]
    assert [row[:3] for row in header["sections"]] == [["positions", 0, 8], ["empty", 8, 0], ["bounds", 8, 34]]
    for _, offset, size, crc in header["sections"]:
        assert zlib.crc32(body[offset : offset + size]) == crc
    # f32, two axes, 2 x 3, then the values.
    assert body[8:18] == bytes([10, 2, 2, 0, 0, 0, 3, 0, 0, 0])
    assert struct.unpack("<6f", body[18:]) == (0, 1, 2, 3, 4, 5)


def test_a_section_that_nobody_asks_for_is_named():
    writer = ContainerWriter("m", 1)
    writer.add("known", b"1")
    writer.add("unknown", b"2")
    reader = ContainerReader(writer.to_bytes(), "a.swz")
    reader.section("known")
    with pytest.raises(BitstreamError, match=r"a\.swz: section 'unknown': method 'm' knows no such section"):
        reader.finish()
    reader.section("unknown")
    reader.finish()


def test_messages_about_strangers_files_are_one_line():
    """A line feed or an escape sequence in a header value, an image name, a column of a .ply."""
    for kind in (BitstreamError, SceneError):
        assert str(kind("name 'a\nerror: \x1b[31mb' of über.png")) == r"name 'a\nerror: \x1b[31mb' of über.png"

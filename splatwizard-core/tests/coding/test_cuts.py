"""Files that may end early: at the cuts that they declare, and nowhere else."""

import contextlib
import json
import struct
import zlib
from pathlib import Path

import pytest

from splatwizard_core.coding.container import MAX_SECTIONS, ContainerReader, ContainerWriter
from splatwizard_core.coding.cuts import Prefix
from splatwizard_core.errors import BitstreamError, UserInputError

PARTS = {"base": b"abcdefgh", "none": b"", "more": b"ijk", "fine": b"lmnopq", "last": b"r"}


def progressive() -> bytes:
    """Three packets: base; none and more; fine and last."""
    writer = ContainerWriter("m", 1)
    for name, data in PARTS.items():
        writer.add(name, data)
        if name in ("base", "more", "last"):
            writer.cut({"base": 20.5, "more": None, "last": 31}[name])
    return writer.to_bytes()


def with_cuts(cuts, sections=PARTS, *, version=2) -> bytes:
    """A file whose cuts are what a stranger thinks up."""
    table, at = [], 0
    for name, data in sections.items():
        table.append([name, at, len(data), zlib.crc32(data)])
        at += len(data)
    header = {"method": "m", "method_version": 1, "raster": {}, "static": {}, "sections": table, "cuts": cuts}
    raw = json.dumps(header).encode()
    head = struct.pack("<4sHI", b"SPWZ", version, len(raw)) + raw + struct.pack("<I", zlib.crc32(raw))
    return head + b"".join(sections.values())


def ends() -> list[int]:
    return [cut["bytes"] for cut in ContainerReader(progressive()).summary()["cuts"]]


def test_a_file_is_read_at_each_of_its_cuts_and_at_no_other_length():
    data, found = progressive(), {}
    for length in range(len(data)):
        with contextlib.suppress(BitstreamError):
            found[length] = ContainerReader(data[:length], "f.swz")
    found[len(data)] = ContainerReader(data)
    assert list(found) == ends() == [len(data) - 10, len(data) - 7, len(data)]
    assert [list(reader.sections) for reader in found.values()] == [["base"], ["base", "none", "more"], list(PARTS)]
    assert [reader.packets for reader in found.values()] == [1, 2, 3]
    for length, reader in found.items():
        assert reader.size == length == sum(reader.summary()["bytes"].values())
        assert "fine" in reader or reader.packets < 3
    with pytest.raises(BitstreamError, match="1 bytes follow the last section"):
        ContainerReader(data + b"x")


def test_truncation_names_the_longest_whole_cut():
    data, (first, second, _) = progressive(), ends()
    with pytest.raises(BitstreamError, match=rf"f\.swz: {second + 1} bytes end at no .* packet 2 \({second} bytes\)"):
        ContainerReader(data[: second + 1], "f.swz")
    with pytest.raises(BitstreamError, match=f"truncated; the first cut is at {first} bytes"):
        ContainerReader(data[: first - 1])


def test_the_first_packets_of_a_file_are_the_file_that_ends_there():
    data = progressive()
    for packets, end in enumerate(ends(), 1):
        short = ContainerReader(data[:end])
        for prefix in (Prefix(packets), Prefix(bytes=end), Prefix(bytes=end + 1, partial=True)):
            part = ContainerReader(data, prefix=prefix)
            assert part.summary() == short.summary()
            assert {name: part.section(name) for name in part.sections} == {n: PARTS[n] for n in short.sections}


def test_partial_reads_the_longest_whole_cut():
    data, (first, second, whole) = progressive(), ends()
    for length in range(first, whole + 1):
        reader = ContainerReader(data[:length], prefix=Prefix(partial=True))
        assert reader.packets == 1 + (length >= second) + (length >= whole)
    with pytest.raises(BitstreamError, match="truncated"):
        ContainerReader(data[: first - 1], prefix=Prefix(partial=True))
    longer = ContainerReader(data + b"x", prefix=Prefix(partial=True))
    assert (longer.packets, longer.size) == (3, whole)


def test_more_than_a_file_holds_cannot_be_asked_for():
    data, (first, second, _) = progressive(), ends()
    with pytest.raises(UserInputError, match="it has 3 packets, 4 are asked for"):
        ContainerReader(data, prefix=Prefix(4))
    with pytest.raises(UserInputError, match="it has 2 packets, 3 are asked for"):
        ContainerReader(data[:second], prefix=Prefix(3))
    with pytest.raises(UserInputError, match=f"first packet ends at {first} bytes"):
        ContainerReader(data, prefix=Prefix(bytes=first - 1))
    plain = ContainerWriter("m", 1).to_bytes()
    for prefix in (Prefix(1), Prefix(bytes=99)):
        with pytest.raises(UserInputError, match="declares no cuts"):
            ContainerReader(plain, prefix=prefix)


def test_damage_before_a_cut_is_found_and_behind_it_is_not_looked_at():
    data = bytearray(progressive())
    data[ends()[0] - 1] ^= 1
    for prefix in (Prefix(), Prefix(1)):
        with pytest.raises(BitstreamError, match="section 'base': its CRC-32"):
            ContainerReader(bytes(data), prefix=prefix)
    data[ends()[0] - 1] ^= 1
    data[-1] ^= 1
    assert ContainerReader(bytes(data), prefix=Prefix(2)).packets == 2
    with pytest.raises(BitstreamError, match="section 'last': its CRC-32"):
        ContainerReader(bytes(data))


def test_partial_stops_before_damage_and_says_so(caplog):
    good, (first, second, _) = progressive(), ends()
    for at, packets in ((-1, 2), (first, 1)):
        data = bytearray(good)
        data[at] ^= 1
        with caplog.at_level("WARNING"):
            part = ContainerReader(bytes(data), f"{packets}.swz", Prefix(partial=True))
        assert part.summary() == ContainerReader(good[: (first, second)[packets - 1]]).summary()
        assert f"CRC-32 does not match: the file is damaged; the {packets} of 3 packets before it are" in caplog.text
        with pytest.raises(BitstreamError, match="CRC-32"):
            ContainerReader(bytes(data), prefix=Prefix(3, partial=True))
    data[first - 1] ^= 1
    with pytest.raises(BitstreamError, match="section 'base': its CRC-32"):
        ContainerReader(bytes(data), prefix=Prefix(partial=True))


GOOD = [[1, 8, None], [3, 11, 20.5], [5, 18, 30]]


@pytest.mark.parametrize(
    ("cuts", "reason"),
    [
        ([], "one to as many"),
        ({}, "one to as many"),
        (None, "one to as many"),
        ("cuts", "one to as many"),
        ([[5, 18, None]] * 6, "one to as many"),
        ([*GOOD[:2], [5, 18]], r"not \[sections, bytes, psnr\]"),
        ([*GOOD[:2], 18], r"not \[sections, bytes, psnr\]"),
        ([*GOOD[:2], [5, 18.0, None]], r"not \[sections, bytes, psnr\]"),
        ([*GOOD[:2], [5, "18", None]], r"not \[sections, bytes, psnr\]"),
        ([[True, 8, None], GOOD[2]], r"not \[sections, bytes, psnr\]"),
        ([*GOOD[:2], [5, 18, "30"]], "PSNR"),
        ([*GOOD[:2], [5, 18, True]], "PSNR"),
        ([*GOOD[:2], [5, 18, [1] * 999]], "PSNR"),
        ([*GOOD[:2], [5, 18, 1e300]], "PSNR"),
        ([GOOD[0], GOOD[0], GOOD[2]], "do not grow"),
        ([GOOD[1], GOOD[0], GOOD[2]], "do not grow"),
        ([[1, 8, None], [2, 8, None], GOOD[2]], "do not grow"),
        ([[0, 0, None], *GOOD], "do not grow"),
        ([[-1, -5, None], *GOOD], "do not grow"),
        ([*GOOD, [6, 25, None]], "beyond the last section"),
        ([GOOD[0], [2**62, 2**62, None]], "beyond the last section"),
        ([[1, 7, None], *GOOD[1:]], "inside of a section"),
        ([[1, 9, None], *GOOD[1:]], "inside of a section"),
        ([GOOD[0], [4, 18, None], [5, 19, None]], "inside of a section"),
        (GOOD[:2], "last cut is not the end"),
    ],
)
def test_hostile_cuts_are_refused_with_the_reason(cuts, reason):
    assert ContainerReader(with_cuts(GOOD)).packets == 3
    data = with_cuts(cuts)
    for length in (len(data), len(data) - 7, len(data) - 10):
        with pytest.raises(BitstreamError, match=reason):
            ContainerReader(data[:length], prefix=Prefix(partial=True))


def test_sections_that_overlap_are_refused_with_cuts_too():
    data = with_cuts(GOOD)
    for old, new in ((b'["more", 8, 3', b'["more", 7, 3'), (b'["fine", 11', b'["fine", 10')):
        (length,) = struct.unpack_from("<I", data, 6)
        raw = data[10 : 10 + length].replace(old, new)
        forged = data[:10] + raw + struct.pack("<I", zlib.crc32(raw)) + data[14 + length :]
        for prefix in (Prefix(), Prefix(1), Prefix(partial=True)):  # also where it lies behind the cut
            with pytest.raises(BitstreamError, match="make no sense in the section table"):
                ContainerReader(forged, prefix=prefix)


def test_thousands_of_cuts_are_read():
    sections = {f"s{i}": b"x" for i in range(MAX_SECTIONS)}
    data = with_cuts([[i, i, None] for i in range(1, MAX_SECTIONS + 1)], sections)
    assert ContainerReader(data[: len(data) - 1000]).packets == MAX_SECTIONS - 1000
    with pytest.raises(BitstreamError, match="one to as many"):
        ContainerReader(with_cuts([[i, i, None] for i in range(1, 20_000)]))


def test_version_and_cuts_belong_together():
    with pytest.raises(BitstreamError, match="must hold exactly"):
        ContainerReader(with_cuts(GOOD, version=1))
    plain = ContainerWriter("m", 1).to_bytes()
    assert plain[4] == 1
    with pytest.raises(BitstreamError, match="must hold exactly cuts, "):
        ContainerReader(plain[:4] + b"\x02" + plain[5:])


def test_the_writer_refuses_cuts_that_no_reader_takes():
    for parts, reason in (
        (("a", None, "b"), "last cut is not the end"),
        (("a", "b", None, None), "do not grow"),
        ((None, "a", "b", None), "do not grow"),
    ):
        writer = ContainerWriter("m", 1)
        for name in parts:
            writer.cut() if name is None else writer.add(name, b"1")
        with pytest.raises(ValueError, match=reason):
            writer.to_bytes()


def test_every_flipped_bit_is_refused():
    data = bytearray(progressive())
    for i in range(len(data)):
        data[i] ^= 1 << (i % 8)
        with pytest.raises(BitstreamError):
            ContainerReader(bytes(data))
        data[i] ^= 1 << (i % 8)


def test_a_file_without_cuts_is_written_as_ever():
    golden = Path(__file__).parent / "golden" / "container_v1.swz"
    assert ContainerReader.open(golden).cuts == []
    assert ContainerReader.open(golden).packets == 0

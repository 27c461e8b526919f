"""What a header says of the distributions that wrote the file."""

import json
import struct
import zlib

import pytest

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.coding.requirements import (
    Requirement,
    dump_requirements,
    parse_requirements,
    requirement_of,
)
from splatwizard_core.errors import BitstreamError

CODECS = Requirement("sw-codecs", "0.2.1", (("coder", "octree"), ("entropy model", "columns")))
CORE = Requirement("splatwizard-core", "0.3")


def test_requirements_come_back_through_a_file():
    writer = ContainerWriter("m", 1)
    writer.requires = [CORE, CODECS]
    reader = ContainerReader(writer.to_bytes())
    assert reader.requires == [CORE, CODECS]
    assert reader.summary()["requires"] == {"splatwizard-core": "0.3", "sw-codecs": "0.2.1"}
    assert requirement_of(reader.requires, "coder", "octree") == CODECS
    assert requirement_of(reader.requires, "coder", "columns") is None


def test_a_file_may_say_nothing():
    assert ContainerReader(ContainerWriter("m", 1).to_bytes()).requires == []


def test_the_command_is_one_that_a_shell_takes_as_it_stands():
    assert CODECS.command == "pip install 'sw-codecs>=0.2.1'"


@pytest.mark.parametrize(
    ("written", "installed", "is_newer"),
    [
        ("0.2", "0.1.9", True),
        ("0.10", "0.9", True),
        ("1.0", "1", False),
        ("1.0.1", "1", True),
        ("1.2rc1", "1.2", False),
        ("0.1", "0.2", False),
        ("1!0.1", "0.1", False),
        ("2.0", "2.0.dev3", False),
    ],
)
def test_releases_are_compared_as_numbers(written, installed, is_newer):
    assert Requirement("sw-x", written).is_newer_than(installed) is is_newer


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        {"sw-x": "0.1"},
        {"sw-x": []},
        {"sw-x": [1]},
        {"sw-x": ["latest"]},
        {"sw-x": ["0.1'; rm -rf ~ #"]},
        {"sw-x": ["0.1\n"]},
        {"sw x": ["0.1"]},
        {"-rf": ["0.1"]},
        {"--index-url=http://evil": ["0.1"]},
        {"": ["0.1"]},
        {"x" * 65: ["0.1"]},
        {"sw-x": ["0.1", "coder"]},
        {"sw-x": ["0.1", "coder:../x"]},
        {"sw-x": ["0.1", *["coder:x"] * 300]},
        {f"sw-{i}": ["0.1"] for i in range(65)},
    ],
)
def test_what_a_shell_or_a_terminal_could_misread_is_refused(value):
    with pytest.raises(ValueError, match="requires"):
        parse_requirements(value)
    with pytest.raises(BitstreamError, match="requires"):
        ContainerReader(with_requires(ContainerWriter("m", 1).to_bytes(), value))


def with_requires(data: bytes, value: object) -> bytes:
    """The same file with another `requires` and a right checksum."""
    header = json.loads(data[10:-4])
    body = json.dumps({**header, "requires": value}).encode()
    return struct.pack("<4sHI", b"SPWZ", 1, len(body)) + body + struct.pack("<I", zlib.crc32(body))


def test_a_distribution_with_an_odd_name_is_not_written():
    with pytest.raises(ValueError, match="distribution and version"):
        dump_requirements([Requirement("sw x", "0.1")])
    assert not Requirement("sw x", "0.1").is_well_formed
    with pytest.raises(ValueError, match="twice"):
        dump_requirements([CORE, CORE])

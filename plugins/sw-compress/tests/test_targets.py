"""Sizes, qualities and ratios as people write them, and as they should not."""

import pytest
from sw_compress.targets import Target, parse_quality

from splatwizard_core.api import UserInputError, parse_size


@pytest.mark.parametrize(
    ("text", "size"),
    [("8MB", 8_000_000), ("8 MiB", 8 << 20), ("800kB", 800_000), ("1.5GB", 1_500_000_000), ("123", 123), (77, 77),
     (".5kib", 512), ("9 B", 9)],
)  # fmt: skip
def test_sizes_are_bytes(text: str | int, size: int):
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["0", "-1", "1e400MB", "8 mbit", "", "MB", "nan", "9999999999999GB", "1,5MB"])
def test_what_is_no_size_is_an_error_that_names_it(text: str):
    with pytest.raises(UserInputError, match="size"):
        parse_size(text)


def test_a_quality_has_decibels_or_none():
    assert parse_quality("45dB") == parse_quality(" 45 db ") == parse_quality(45) == 45.0


@pytest.mark.parametrize("text", ["", "dB", "nan", "5", "99dB", "45dBA"])
def test_what_is_no_quality_is_an_error(text: str):
    with pytest.raises(UserInputError, match="quality"):
        parse_quality(text)


def test_one_target_or_the_usual_one():
    assert Target.of(None, None, None, 10) == Target(quality=40.0)
    assert Target.of(None, None, "20", 1_000_000) == Target(size=50_000)
    with pytest.raises(UserInputError, match="one of them"):
        Target.of("1MB", 40, None, 10)
    with pytest.raises(UserInputError, match="ratio"):
        Target.of(None, None, 2, None)

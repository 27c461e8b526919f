"""What all chapters read with: integers and varints off the front of some bytes, and bits."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any


class PageError(Exception):
    """The file is not what the page describes."""


def check(claim: bool, what: str) -> None:
    if not claim:
        raise PageError(what)


def unzigzag(code: int) -> int:
    return code // 2 if code % 2 == 0 else -(code + 1) // 2


class Bytes:
    """Takes fields off the front."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = bytes(data), 0

    def take(self, count: int) -> bytes:
        check(self.at + count <= len(self.data), "too short")
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, form: str) -> tuple[Any, ...]:
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def one(self, form: str) -> int:
        (value,) = self.unpack(form)
        return int(value)

    def varint(self) -> int:
        value = shift = 0
        while True:
            byte = self.take(1)[0]
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def signed(self) -> int:
        return unzigzag(self.varint())

    def rest(self) -> bytes:
        return self.take(len(self.data) - self.at)

    def bits(self) -> Iterator[str]:
        """The rest, each byte from its least significant bit."""
        return iter(f"{byte >> i & 1}" for byte in self.rest() for i in range(8))

    def done(self) -> None:
        check(self.at == len(self.data), "bytes are left")

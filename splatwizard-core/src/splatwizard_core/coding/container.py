"""The single file (`.swz`): everything that a decoder needs, in named sections, each with length and CRC-32.

Layout and keys of the header: docs/bitstream.md, chapter 1. In version 2 the header also holds `cuts` (see cuts.py):
the file may end at any of them. Source: specification of the codec library, container.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from splatwizard_core.base.files import write_atomic
from splatwizard_core.base.strict_json import dump_strict, load_strict
from splatwizard_core.base.warned import warn_once
from splatwizard_core.coding.array_section import pack_array, unpack_array
from splatwizard_core.coding.cuts import WHOLE, Cut, Prefix, chosen_cut, parse_cuts
from splatwizard_core.coding.limits import beyond_limit, decoded_limit
from splatwizard_core.coding.requirements import Requirement, dump_requirements, parse_requirements
from splatwizard_core.errors import BitstreamError, PluginError, SplatwizardError, UserInputError, no_file

MAGIC = b"SPWZ"
VERSION = 2
MAX_HEADER = 1 << 19  # 512 KiB; anything longer belongs into a section
MAX_SECTIONS = 4096
NAME = re.compile(r"(?!header$)[A-Za-z0-9_][A-Za-z0-9_./-]{0,63}")  # "header" would clash in the breakdown
METHOD_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
PREFIX = struct.Struct("<4sHI")
CRC = struct.Struct("<I")
WORLD_ORIGIN = "world_origin"
"""Header value beside those of the method: where the origin of the coordinates lies in the world of the scene."""
HEADER = {"method": str, "method_version": int, "raster": dict, "static": dict, "sections": list}


class ContainerWriter:
    """Collects sections and writes them as one file.

    method      name of the method that will decode the file
    version     version of that method's own layout, >= 0
    raster      what the decoded scene asks of a rasterizer, JSON values, such as {"antialias": False, "sh_degree": 3}

    `static` is a dict of JSON values that goes into the header: fill it in place. `requires` is what a reader is told
    to install if it lacks something; whoever knows the installed distributions fills it, from what was asked of the
    registries and from `required`, the (kind, name) of what `require` stated.
    """

    def __init__(self, method: str, version: int, *, raster: Mapping[str, Any] | None = None) -> None:
        if not METHOD_NAME.fullmatch(method):
            raise ValueError(f"method name {method!r} cannot be written into a file")
        if isinstance(version, bool) or not 0 <= version < 1 << 31:
            raise ValueError(f"method version {version!r} is not a small non-negative integer")
        self.method, self.version = method, version
        self.raster: dict[str, Any] = dict(raster or {})
        self.static: dict[str, Any] = {}
        self.world_origin: tuple[float, float, float] | None = None
        self.requires: list[Requirement] = []
        self.required: list[tuple[str, str]] = []
        self._sections: dict[str, bytes] = {}
        self._cuts: list[Cut] = []

    def add(self, name: str, data: bytes | bytearray | memoryview) -> None:
        """Append a section. Raises ValueError if the name is malformed or taken."""
        if not NAME.fullmatch(name):
            raise ValueError(f"section name {name!r} must match {NAME.pattern}")
        if name in self._sections:
            raise ValueError(f"section '{name}' was already added")
        if len(self._sections) >= MAX_SECTIONS:
            raise ValueError(f"a file holds at most {MAX_SECTIONS} sections")
        self._sections[name] = bytes(data)

    def add_array(self, name: str, array: npt.ArrayLike) -> None:
        """Append a section that states dtype and shape: bool, (u)int8-64 or float16-64, at most 8 axes."""
        self.add(name, pack_array(array))

    def cut(self, psnr: float | None = None) -> None:
        """Declare a cut after the sections added so far; a method with cuts declares the last one after all of them.

        psnr    mean of the training views with what stands before the cut, dB, if it is known
        """
        self._cuts.append(Cut(len(self._sections), sum(map(len, self._sections.values())), psnr))

    def require(self, kind: str, name: str) -> None:
        """State that decoding needs a registered part that the method imports, such as ("entropy model", "columns").

        What a method loads from a registry while it encodes is recorded without this.
        """
        if (kind, name) not in self.required:
            self.required.append((kind, name))

    @property
    def sections(self) -> dict[str, int]:
        """Bytes of each section added so far."""
        return {name: len(data) for name, data in self._sections.items()}

    def allow(self, decoded: int, what: str) -> None:
        """Raise SplatwizardError if the sections added so far may not stand for `decoded` bytes of `what`.

        A method that decodes to far more than it stores calls it at the end of `encode`, so that it writes no file
        which its own `decode` (`ContainerReader.allow`) refuses.
        """
        size = sum(self.sections.values())
        if decoded > decoded_limit(size):
            raise SplatwizardError(
                f"{what} of {decoded:,} bytes in {size:,} bytes of file is more than a reader accepts "
                f"({decoded_limit(size):,}): most of it repeats itself"
            )

    def to_bytes(self) -> bytes:
        """The whole file. Raises ValueError if header values are no JSON data, or for cuts that make no sense."""
        table, offset = [], 0
        for name, data in self._sections.items():
            table.append([name, offset, len(data), zlib.crc32(data)])
            offset += len(data)
        if self._cuts:
            parse_cuts([list(cut) for cut in self._cuts], [0, *accumulate(map(len, self._sections.values()))])
        header = dump_strict(
            {
                "method": self.method,
                "method_version": self.version,
                **({"requires": dump_requirements(self.requires)} if self.requires else {}),
                "raster": self.raster,
                "static": self.static | ({WORLD_ORIGIN: list(self.world_origin)} if self.world_origin else {}),
                "sections": table,
                **({"cuts": [list(cut) for cut in self._cuts]} if self._cuts else {}),
            }
        )
        if len(header) > MAX_HEADER:
            raise ValueError(f"the header is {len(header):,} bytes, at most {MAX_HEADER:,}: use a section")
        prefix = PREFIX.pack(MAGIC, 2 if self._cuts else 1, len(header))
        return b"".join([prefix, header, CRC.pack(zlib.crc32(header)), *self._sections.values()])

    def write(self, path: str | os.PathLike[str]) -> int:
        """Write the file and return its size in bytes.

        Atomic: the path holds either what it held before or the complete new file, also after a crash.
        """
        data = self.to_bytes()
        write_atomic(path, data)
        return len(data)


class ContainerReader:
    """A parsed file; everything is checked when it is opened.

    data    the file, up to its end or to a declared cut
    name    what error messages call it
    prefix  how much of a file with cuts is read; nothing behind that exists for the reader

    method, version     which method decodes it, and the version of its layout
    requires            which distributions wrote it; empty if the file does not say
    raster, static      header values, plain JSON data
    world_origin        where the origin of the coordinates lies in the world of the scene, unchecked; None: not told
    sections            bytes of each section that is read, in file order
    size                bytes that are read = header_bytes + the sum over `sections`
    cuts, packets       the cuts that the file declares, and how many packets are read; of a file without cuts [] and 0

    Raises BitstreamError that names file, section and reason, in time and memory bounded by len(data).
    """

    def __init__(self, data: bytes, name: str = "file", prefix: Prefix = WHOLE) -> None:
        self._read(io.BytesIO(data), len(data), name, prefix)

    @classmethod
    def open(cls, path: str | os.PathLike[str], prefix: Prefix = WHOLE) -> ContainerReader:
        """Read a file. Raises BitstreamError also if the path is not a readable file."""
        where = Path(path)
        reader = cls.__new__(cls)
        try:
            if not where.is_file():
                raise BitstreamError(f"{where}: {no_file(where)}")
            with where.open("rb") as file:
                reader._read(file, os.fstat(file.fileno()).st_size, where.name, prefix)
        except OSError as error:
            raise BitstreamError(f"{where}: cannot be read: {error.strerror}") from error
        return reader

    def _read(self, file: BinaryIO, size: int, name: str, prefix: Prefix) -> None:
        self.name = name
        self.size = size
        header = self._header(file)
        self.header_bytes = file.tell()
        self.method: str = header["method"]
        self.version: int = header["method_version"]
        try:
            self.requires = parse_requirements(header.get("requires", {}))
        except ValueError as error:
            raise self._damage(str(error), "header") from error
        self.raster: dict[str, Any] = header["raster"]
        self.static: dict[str, Any] = header["static"]
        self.world_origin = self.static.pop(WORLD_ORIGIN, None)  # of the scene, no value of the method
        self._payload = self._split(header, file, prefix)
        self.sections: dict[str, int] = {key: len(part) for key, part in self._payload.items()}
        self._unread = set(self._payload)

    def _prefix(self, data: bytes) -> tuple[int, int]:
        """Container version and header length; a wrong file is refused before it is read whole."""
        if not data:
            raise BitstreamError(f"{self.name}: the file is empty")
        if data[:4] != MAGIC[: len(data[:4])]:
            raise BitstreamError(f"{self.name}: not a .swz file (it starts with {data[:4]!r}, not {MAGIC!r})")
        if len(data) < PREFIX.size:
            raise BitstreamError(f"{self.name}: {len(data)} bytes are too few for a .swz file: it is truncated")
        _, version, length = PREFIX.unpack(data)
        if version < 1:
            raise BitstreamError(f"{self.name}: container version {version} does not exist: the file is damaged")
        if length > MAX_HEADER:
            raise BitstreamError(f"{self.name}: header of {length:,} bytes, at most {MAX_HEADER:,} are allowed")
        return version, length

    def _header(self, file: BinaryIO) -> dict[str, Any]:
        version, length = self._prefix(file.read(PREFIX.size))
        raw = file.read(length)
        sound = CRC.pack(zlib.crc32(raw)) == file.read(CRC.size)
        if version > VERSION:
            raise self._too_new(version, raw if sound else b"")
        start = PREFIX.size + length + CRC.size
        if self.size < start:
            raise self._damage(f"the file ends inside its header ({self.size:,} of {start:,} bytes): it is truncated")
        if not sound:
            raise self._damage("the CRC-32 of the header does not match: the file is damaged", "header")
        try:
            header = load_strict(raw)
        except ValueError as error:
            raise self._damage(f"header is not acceptable JSON: {error}", "header") from error
        keys = set(HEADER) | ({"cuts"} if version == 2 else set())
        if not isinstance(header, dict) or set(header) - {"requires"} != keys:
            raise self._damage(
                f"header must hold exactly {', '.join(sorted(keys))}, and it may hold requires", "header"
            )
        for key, kind in HEADER.items():
            if type(header[key]) is not kind:
                raise self._damage(f"header value '{key}' is not of type {kind.__name__}", "header")
        if not METHOD_NAME.fullmatch(header["method"]) or not 0 <= header["method_version"] < 1 << 31:
            raise self._damage("header names no valid method and version", "header")
        return header

    def _too_new(self, version: int, raw: bytes) -> BitstreamError:
        """Of a later container version only the key `requires` of the header is looked at: it keeps its form."""
        command = "pip install --upgrade splatwizard-core"
        with contextlib.suppress(ValueError, AttributeError):
            needed = parse_requirements(load_strict(raw).get("requires"))
            command = {each.distribution: each.command for each in needed}.get("splatwizard-core", command)
        return BitstreamError(
            f"{self.name}: container version {version} is newer than {VERSION}, the newest that this installation "
            f"reads: upgrade splatwizard-core with {command}"
        )

    def _split(self, header: dict[str, Any], file: BinaryIO, prefix: Prefix) -> dict[str, bytes]:
        rows, start = self._rows(header["sections"]), file.tell()
        available = self.size - start
        self.cuts: list[Cut] = []
        self.packets = 0
        if "cuts" in header:
            try:
                self.cuts = parse_cuts(header["cuts"], [0, *accumulate(length for _, length, _ in rows)])
            except ValueError as error:
                raise self._damage(str(error), "header") from error
        elif prefix.packets is not None or prefix.bytes is not None:
            raise UserInputError(f"{self.name}: it declares no cuts, it is decoded whole or not at all")
        elif prefix.partial:
            warn_once(f"{self.name}: it declares no cuts, so that --partial is of no use to it")
        if self.cuts and (prefix.partial or available <= self.cuts[-1].bytes):
            try:
                self.packets = chosen_cut(self.cuts, available, start, prefix, self.name)
            except ValueError as error:
                raise self._damage(str(error)) from error
            sections, available, _ = self.cuts[self.packets - 1]
            rows, self.size = rows[:sections], start + available
        payload: dict[str, bytes] = {}
        for key, length, crc in rows:
            part = file.read(min(length, available))  # never more than there is
            if len(part) != length:
                raise self._damage(f"is {len(part):,} bytes, header says {length:,}: the file is truncated", key)
            if zlib.crc32(part) != crc:
                damage = self._damage("its CRC-32 does not match: the file is damaged", key)
                whole = [cut for cut in self.cuts if cut.sections <= len(payload)]
                if not prefix.partial or prefix.packets is not None or not whole:
                    raise damage
                warn_once(f"{damage}; the {len(whole)} of {len(self.cuts)} packets before it are read")
                self.packets, self.size = len(whole), start + whole[-1].bytes
                return dict(list(payload.items())[: whole[-1].sections])
            payload[key] = part
            available -= length
        if available:
            raise self._damage(f"{available:,} bytes follow the last section: the file is damaged")
        return payload

    def _rows(self, table: list[Any]) -> list[tuple[str, int, int]]:
        """Name, length and CRC-32 of each section."""
        if len(table) > MAX_SECTIONS:
            raise self._damage(f"{len(table):,} sections, at most {MAX_SECTIONS} are allowed", "header")
        found: dict[str, tuple[str, int, int]] = {}
        position = 0
        for row in table:
            if not isinstance(row, list) or len(row) != 4 or not isinstance(row[0], str):
                raise self._damage("a row of the section table is not [name, offset, length, crc32]", "header")
            key, *numbers = row
            if not NAME.fullmatch(key) or key in found:
                raise self._damage(f"section name {key[:64]!r} is malformed or appears twice", "header")
            if any(type(n) is not int or n < 0 for n in numbers) or numbers[0] != position:
                raise self._damage("offset, length or crc32 make no sense in the section table", key)
            _, length, crc = numbers
            found[key] = key, length, crc
            position += length
        return list(found.values())

    def _damage(self, reason: str, section: str | None = None) -> BitstreamError:
        where = self.name if section in (None, "header") else f"{self.name}: section '{section}'"
        return BitstreamError(f"{where}: {reason}", section=section)

    @property
    def made_on(self) -> str | None:
        """Description of the machine that alone can decode the file (header value `made_on`); None: any machine can."""
        if "made_on" not in self.static:
            return None
        machine = self.static["made_on"]
        return ", ".join(f"{key} {value}"[:80] for key, value in machine.items()) if isinstance(machine, dict) else "?"

    def __contains__(self, name: object) -> bool:
        return name in self._payload

    def section(self, name: str) -> bytes:
        """The bytes of a section. Raises BitstreamError if the file has none of that name."""
        if name not in self._payload:
            raise self._damage("is missing", name)
        self._unread.discard(name)
        return self._payload[name]

    def finish(self) -> None:
        """Raise BitstreamError if a section was never asked for: its method knows none of that name."""
        for name in sorted(self._unread):
            raise self._damage(f"method '{self.method}' knows no such section", name)

    @contextlib.contextmanager
    def decoding(self, name: str) -> Iterator[bytes]:
        """The bytes of a section for a block that decodes them; what goes wrong in it is blamed on the section.

        BitstreamError, ValueError and their like that leave the block become a BitstreamError which names file,
        section and reason:

            with reader.decoding("positions") as data:
                points = codec.decode(data)
        """
        data = self.section(name)
        try:
            yield data
        except BitstreamError as error:
            if error.section is not None:
                raise
            raise self._damage(str(error), name) from error
        except (ValueError, LookupError, ArithmeticError) as error:
            raise self._damage(f"{type(error).__name__}: {error}", name) from error

    def array(
        self,
        name: str,
        *,
        dtype: npt.DTypeLike,
        ndim: int | None = None,
        shape: Sequence[int | None] | None = None,
        finite: bool = False,
    ) -> npt.NDArray[Any]:
        """An array written by `add_array`, writable, in native byte order.

        dtype   what it must be
        ndim    how many axes it must have
        shape   its shape, with None for an axis of any length
        finite  refuse NaN and infinities (float dtypes)

        Raises BitstreamError if any of that does not hold.
        """
        try:
            found = unpack_array(self.section(name))
        except ValueError as error:
            raise self._damage(str(error), name) from error
        if found.dtype != np.dtype(dtype):
            raise self._damage(f"dtype is {found.dtype}, must be {np.dtype(dtype)}", name)
        if ndim is not None and found.ndim != ndim:
            raise self._damage(f"shape is {list(found.shape)}, must have {ndim} axes", name)
        if shape is not None and (
            len(shape) != found.ndim
            or any(want not in (None, have) for want, have in zip(shape, found.shape, strict=True))
        ):
            wanted = ", ".join("any" if n is None else str(n) for n in shape)
            raise self._damage(f"shape is {list(found.shape)}, must be [{wanted}]", name)
        if finite and not bool(np.isfinite(found).all()):
            raise self._damage("holds values that are not finite", name)
        return found

    def allow(self, decoded: int, what: str) -> None:
        """Raise BitstreamError if a file of this size may not stand for `decoded` bytes of `what`.

        To be asked before anything of that size is allocated; `decoded_limit` has the rule. The header does not count:
        it holds no model.
        """
        if (reason := beyond_limit(decoded, sum(self.sections.values()))) is not None:
            raise self._damage(f"claims {what} of {reason}", "header")

    def integer(self, key: str, *, low: int, high: int) -> int:
        """The integer `static[key]` in low..high. Raises BitstreamError if it is missing or outside."""
        value = self.static.get(key)
        if type(value) is not int or not low <= value <= high:
            raise self._damage(f"header value '{key}' is {value!r:.80}, must be an integer in {low}..{high}", "header")
        return value

    def number(self, key: str, *, low: float, high: float) -> float:
        """The number `static[key]` in low..high. Raises BitstreamError if it is missing or outside."""
        value = self.static.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
            raise self._damage(f"header value '{key}' is {value!r:.80}, must be a number in {low}..{high}", "header")
        return float(value)

    def text(self, key: str, *, choices: Sequence[str]) -> str:
        """The string `static[key]`, one of `choices`; else BitstreamError, or PluginError if the file requires it."""
        value = self.static.get(key)
        if not isinstance(value, str) or value not in choices:
            bad = self._damage(f"header value '{key}' is {value!r:.80}, must be one of {', '.join(choices)}", "header")
            kinds = [kind for each in self.requires for kind, name in each.provided if name == value]
            raise PluginError(str(bad), kind=kinds[0], name=value) if kinds else bad
        return value

    def summary(self) -> dict[str, Any]:
        """Facts for `sw info`: identity, requirements, bytes by section that sum to `size`, and each cut."""
        return {
            "container_version": 2 if self.cuts else 1,
            "method": self.method,
            "method_version": self.version,
            "requires": {each.distribution: each.version for each in self.requires},
            "raster": self.raster,
            "static": self.static | ({WORLD_ORIGIN: self.world_origin} if self.world_origin is not None else {}),
            "size": self.size,
            "bytes": {"header": self.header_bytes, **self.sections},
            "packets": self.packets,
            "cuts": [
                {"packets": number, "bytes": self.header_bytes + cut.bytes, "psnr": cut.psnr}
                for number, cut in enumerate(self.cuts, 1)
            ],
        }

"""A progressive file on its way: it can be opened when its first packet is whole, and again with each further one.

What has arrived is kept as a file that ends at its last whole cut, so that everything opens it like any other.
"""

from __future__ import annotations

import json
import struct
import threading
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from urllib.parse import unquote, urlsplit

from splatwizard_core.api import BitstreamError, ContainerReader, UserInputError
from splatwizard_core.tooling import Prefix, write_atomic

MAGIC, OPENING, CRC, MOST_HEADER = b"SPWZ", struct.Struct("<4sHI"), 4, 1 << 19
"""Of a .swz: magic, container version and bytes of the header, which a CRC-32 follows."""
CHUNK = 1 << 16
TIMEOUT = 30.0
"""Seconds without a byte after which a download has failed."""
MOST = 1 << 32
"""Bytes of a file that is shown."""


class Arriving:
    """Download of a .swz in a thread.

    url     http or https
    folder  of the file, which ends at the last cut that is whole; one without cuts is there when all of it is
    woken   called from the thread when more packets are whole, or the download has ended
    """

    def __init__(self, url: str, folder: Path, woken: Callable[[], None] = lambda: None) -> None:
        self.url, self.woken = url, woken
        name = Path(unquote(urlsplit(url).path)).name
        self.file = folder / (name if name.endswith(".swz") else "scene.swz")
        self.packets, self.declared = 0, 0
        self.ended = False
        self.error: Exception | None = None
        self._data = bytearray()
        self._ends: list[int] = []
        self._changed = threading.Condition()
        threading.Thread(target=self._download, daemon=True, name="download").start()

    @property
    def told(self) -> str:
        """Share that is there, in one line; nothing once all is."""
        if not self.ended:
            return f"{self.packets} of {self.declared} packets have arrived"
        return f"{self.packets} of {self.declared} packets arrived: {self.error}" if self.error else ""

    def wait(self) -> None:
        """Wait for something that can be opened. Raises BitstreamError or UserInputError if there is nothing."""
        with self._changed:
            self._changed.wait_for(lambda: self.ended or self.packets)
        if not self.packets:
            assert self.error is not None
            raise self.error

    def _download(self) -> None:
        try:
            with urllib.request.urlopen(self.url, timeout=TIMEOUT) as answer:
                while chunk := answer.read1(CHUNK):
                    self._data += chunk
                    self._look()
            self._take(ContainerReader(bytes(self._data), self.file.name))
        except (OSError, ValueError, urllib.error.HTTPError) as error:
            self.error = UserInputError(f"{self.url}: {error}")
        except BitstreamError as error:
            self.error = error
        finally:
            with self._changed:
                self.ended = True
                self._changed.notify_all()
            self.woken()

    def _look(self) -> None:
        """Keep what has arrived, if another packet is whole."""
        size = len(self._data)
        if self._data[:4] != MAGIC[:size] or size > MOST:
            raise BitstreamError(f"{self.url}: this is no .swz file of at most {MOST:,} bytes")
        self._ends = self._ends or self._first_end()
        while self.packets < len(self._ends) and size >= self._ends[self.packets]:
            whole = Prefix(sum(end <= size for end in self._ends), partial=True)
            self._take(ContainerReader(bytes(self._data), self.file.name, whole))

    def _first_end(self) -> list[int]:
        """Place of the first cut, by the opening that has arrived (docs/bitstream.md); nothing if it does not tell."""
        if len(self._data) < OPENING.size:
            return []
        _, version, length = OPENING.unpack_from(self._data)
        start = OPENING.size + length + CRC
        if version < 2 or length > MOST_HEADER or len(self._data) < start:
            return []
        try:
            return [start + int(json.loads(self._data[OPENING.size : start - CRC])["cuts"][0][1])]
        except (ValueError, LookupError, TypeError):
            return []  # what is wrong is told when all has arrived

    def _take(self, reader: ContainerReader) -> None:
        self._ends = [reader.header_bytes + cut.bytes for cut in reader.cuts]
        packets = reader.packets or 1
        if packets <= self.packets:
            return
        write_atomic(self.file, bytes(self._data[: reader.size]))
        with self._changed:
            self.packets, self.declared = packets, len(self._ends) or 1
            self._changed.notify_all()
        self.woken()

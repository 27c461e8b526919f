"""One file from the web to disk: resumed after any interruption, verified, whole or not there.

The bytes come through pooch's HTTPDownloader. What pooch has not, is here: going on where a connection broke (HTTP
ranges, guarded by the server's ETag or date so that two versions of a file are never joined), and waiting and trying
again. Beside FILE lie FILE.part, what came so far, and FILE.part.json, of what it is a part.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

from splatwizard_core.api import CapabilityError, track
from splatwizard_core.tooling import Bar, write_json
from sw_datasets.errors import FetchError, UnreachableError

CHUNK_BYTES = 1 << 15  # what a broken connection costs at most
ATTEMPTS = 6  # in a row without one new byte; with the pauses below that is half a minute of silence
PAUSE_SECONDS = 1.0  # before the second attempt; doubled for each further one
TIMEOUT_SECONDS = 30.0  # without a byte
MEGABYTE = 1_000_000
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
RETRIED = (408, 425, 429, 500, 502, 503, 504)
"""Answers that pass: too busy, being restarted."""


@dataclass(frozen=True)
class Fetched:
    """A file that was downloaded.

    verified    its SHA-256 is the one that was pinned; False: none was
    """

    path: Path
    bytes: int
    sha256: str
    verified: bool


@dataclass
class _Part:
    """The file that FILE.part is a part of: address, length in all (None: unknown), and the marks of its version."""

    url: str
    total: int | None = None
    etag: str | None = None
    modified: str | None = None


def require_pooch() -> Any:
    """Import pooch. Raises CapabilityError that says how to install it."""
    try:
        return importlib.import_module("pooch")
    except ImportError as error:
        raise CapabilityError(
            f"downloading needs the package pooch ({error}): pip install 'sw-datasets[download]'",
            missing=["pooch"],
        ) from error


def download(
    url: str,
    target: Path,
    *,
    sha256: str | None = None,
    size: int | None = None,
    room_for: Callable[[int], int] = lambda size: size,
    on_notice: Callable[[str], None] = lambda text: None,
    pause: Callable[[float], None] = time.sleep,
) -> Fetched:
    """Download `url` to `target`, going on from what an earlier call left; returns at once if `target` is there.

    sha256      hexadecimal, all digits or the first ones; None: the file stays unverified
    size        bytes that it must have, None if unknown
    room_for    size of the file -> bytes that the disk must hold for it in all, such as to unpack it afterwards
    on_notice   gets a sentence when a connection broke, or when the server cannot resume
    pause       waits for so many seconds between attempts

    Raises FetchError in one or two lines: not enough space, another size or checksum than pinned; UnreachableError: not
    there, no connection. What came is kept in every case: a mistyped pin shall not cost gigabytes. CapabilityError
    without pooch.
    """
    if not target.exists():
        pooch = require_pooch()
        target.parent.mkdir(parents=True, exist_ok=True)
        _Transfer(url, target, size, room_for, on_notice, pause, pooch).run()
    return check_file(target, sha256=sha256, size=size)


def check_file(path: Path, *, sha256: str | None = None, size: int | None = None) -> Fetched:
    """Hold a file against what is pinned of it. Raises FetchError that says what differs."""
    found = path.stat().st_size
    again = "delete it to fetch it again"
    if size is not None and found != size:
        raise FetchError(f"{path}: {found:,} bytes, the registry says {size:,}; {again}")
    digest = sha256_with_progress(path)
    if sha256 is not None and not digest.startswith(sha256.lower()):
        raise FetchError(
            f"{path}: SHA-256 is {digest}, pinned is {sha256.lower()}: the file was changed or damaged ({again}), "
            "or the pin is of another one"
        )
    return Fetched(path, found, digest, sha256 is not None)


def sha256_with_progress(path: Path) -> str:
    """SHA-256 of a file, hexadecimal; shows progress."""
    import hashlib

    sha = hashlib.sha256()
    with byte_progress(f"verify {path.name}", path.stat().st_size) as count, path.open("rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            sha.update(block)
            count(len(block))
    return sha.hexdigest()


@contextlib.contextmanager
def byte_progress(label: str, total: int | None, start: int = 0) -> Iterator[Callable[[int], None]]:
    """Show progress in MB; yields a function that is called with numbers of bytes."""
    whole = None if total is None else -(-total // MEGABYTE)
    with track(label, total=whole, start=start // MEGABYTE, unit="MB") as bar:
        yield _Counter(bar, start)


class _Counter:
    """Counts bytes for a bar that counts megabytes."""

    def __init__(self, bar: Bar, start: int) -> None:
        self.bar, self.bytes = bar, start

    def __call__(self, more: int) -> None:
        self.bytes += more
        self.bar.advance(self.bytes // MEGABYTE - self.bar.done)


class _Transfer:
    """One file on its way, over as many connections as it takes."""

    def __init__(
        self,
        url: str,
        target: Path,
        size: int | None,
        room_for: Callable[[int], int],
        on_notice: Callable[[str], None],
        pause: Callable[[float], None],
        pooch: Any,
    ) -> None:
        self.url, self.target, self.size = url, target, size
        self.room_for, self.on_notice, self.pause, self.pooch = room_for, on_notice, pause, pooch
        self.path = target.with_name(f"{target.name}.part")
        self.note = target.with_name(f"{target.name}.part.json")
        self.part = self._read_note()

    def run(self) -> None:
        """Connect until the file is whole. Raises FetchError."""
        failures = 0
        while True:
            before = self._have()
            try:
                if self.part.total is None or before != self.part.total:
                    self._connect(before)
            except _Broken as error:
                failures = 1 if self._have() > before else failures + 1
                if failures >= ATTEMPTS:
                    raise UnreachableError(
                        f"{self.url}: {error}; {self._have():,} bytes are kept, the same command goes on from there",
                        address=self.url,
                    ) from error
                self.on_notice(f"{error}: going on from {self._have():,} bytes")
                self.pause(PAUSE_SECONDS * 2 ** (failures - 1))
                continue
            except OSError as error:
                if error.errno not in NO_SPACE:
                    raise
                raise FetchError(
                    f"{self.path}: the disk is full; {self._have():,} bytes are kept, make space and give the same "
                    "command again",
                    address=self.url,
                ) from error
            self.path.replace(self.target)
            self.note.unlink(missing_ok=True)
            return

    def _connect(self, start: int) -> None:
        """One connection, which brings the rest of the file. Raises _Broken if it does not, FetchError for good."""
        from requests.exceptions import RequestException

        headers = {"Accept-Encoding": "identity"}  # the bytes of the file itself, which ranges count
        if start:
            headers["Range"] = f"bytes={start}-"
            validator = self.part.etag or self.part.modified
            if validator is not None:
                headers["If-Range"] = validator  # the whole file, should it be another one by now
        sink = _Sink(self, start)
        downloader = self.pooch.HTTPDownloader(
            chunk_size=CHUNK_BYTES, headers=headers, timeout=TIMEOUT_SECONDS, hooks={"response": sink.begin}
        )
        try:
            with sink:
                downloader(self.url, sink, None)
        except _Complete:
            return
        except RequestException as error:
            self._explain(error)
        if self.part.total is not None and self._have() < self.part.total:
            raise _Broken("the connection ended")

    def _explain(self, error: Any) -> None:
        status = getattr(error.response, "status_code", None)
        if status is not None and status not in RETRIED:
            reason = getattr(error.response, "reason", "") or ""
            told = f"{self.url}: the server answers {status} {reason}".rstrip()
            raise UnreachableError(told, address=self.url) from error
        from requests.exceptions import ChunkedEncodingError, InvalidSchema, InvalidURL, MissingSchema, TooManyRedirects

        if isinstance(error, (InvalidSchema, InvalidURL, MissingSchema, TooManyRedirects)):
            raise FetchError(f"{self.url}: {error}", address=self.url) from error
        broken = isinstance(error, ChunkedEncodingError)
        text = f"the server answers {status}" if status is not None else "" if broken else _first_words(error)
        text = text or "the connection broke"
        raise _Broken(text) from error

    def _have(self) -> int:
        return self.path.stat().st_size if self.path.exists() else 0

    def _read_note(self) -> _Part:
        """Read the note beside the part. Another address, or no readable note: the part is deleted."""
        try:
            part = _Part(**json.loads(self.note.read_bytes()))
        except (OSError, ValueError, TypeError):
            part = _Part("")
        if part.url != self.url:
            self.path.unlink(missing_ok=True)
            self.note.unlink(missing_ok=True)
            return _Part(self.url)
        return part

    def begin(self, response: Any, start: int) -> int:
        """Return the byte of the file at which the body of an answer begins."""
        if response.status_code == 416:
            total = _total(response.headers.get("Content-Range", ""))
            if total is not None and total == start:
                raise _Complete  # everything had come, only the renaming was missing
            self._discard()
            raise _Broken("the server has no such range; starting over")
        length = response.headers.get("Content-Length", "")
        if response.status_code == 206:
            match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", response.headers.get("Content-Range", ""))
            total = None if match is None or match[2] == "*" else int(match[2])
            changed = self.part.total is not None and total is not None and total != self.part.total
            changed |= self._is_another(response.headers)
            if match is None or int(match[1]) != start or changed:
                self._discard()
                raise _Broken("the server sent another part than asked for, starting over")
        else:
            if start:
                self.on_notice(f"{self.url}: the server cannot resume this file (or it changed): from the beginning")
                self._discard()
            start, total = 0, int(length) if length.isdigit() else None
        if self.size is not None and total is not None and total != self.size:
            self._discard()
            raise FetchError(
                f"{self.url}: the server offers {total:,} bytes, the registry says {self.size:,}", address=self.url
            )
        etag = response.headers.get("ETag")
        self.part = _Part(
            self.url,
            total if total is not None else self.part.total,
            None if etag is None or etag.startswith("W/") else etag,  # weak ones promise nothing about bytes
            response.headers.get("Last-Modified"),
        )
        self._check_space(start)
        write_json(self.note, asdict(self.part))
        return start

    def _is_another(self, headers: Mapping[str, str]) -> bool:
        """Whether the marks of an answer are those of another version than the part's."""
        pairs = ((self.part.etag, headers.get("ETag")), (self.part.modified, headers.get("Last-Modified")))
        return any(ours is not None and theirs is not None and ours != theirs for ours, theirs in pairs)

    def _check_space(self, start: int) -> None:
        if self.part.total is None:
            return
        needed = self.room_for(self.part.total) - start
        free = shutil.disk_usage(self.target.parent).free
        if needed > free:
            raise FetchError(
                f"not enough space in {self.target.parent}: {needed / 1e9:.2f} GB are needed for {self.target.name} "
                f"and what it is unpacked to, {free / 1e9:.2f} GB are free",
                address=self.url,
            )

    def _discard(self) -> None:
        self.path.unlink(missing_ok=True)
        self.part = _Part(self.url)


class _Sink(contextlib.ExitStack):
    """The file object that pooch writes to: the part file, opened when the answer says where its bytes belong."""

    def __init__(self, transfer: _Transfer, start: int) -> None:
        super().__init__()
        self.transfer, self.start = transfer, start
        self.file: BinaryIO | None = None
        self.count: Callable[[int], None] = lambda more: None

    def begin(self, response: Any, *_: Any, **__: Any) -> None:
        """Called by requests with each answer before its body is read, redirections included."""
        if response.status_code not in (200, 206, 416):
            return
        start = self.transfer.begin(response, self.start)
        self.file = self.enter_context(self.transfer.path.open("r+b" if start else "wb"))
        self.file.seek(start)
        label = f"download {self.transfer.target.name}"
        self.count = self.enter_context(byte_progress(label, self.transfer.part.total, start))

    def write(self, block: bytes) -> int:
        """Write the next bytes of the body."""
        if self.file is None:
            raise _Broken("the server answered nothing that can be kept")
        announced = self.transfer.part.total
        total = announced if announced is not None else self.transfer.size
        if total is not None and self.file.tell() + len(block) > total:
            said = "were announced" if announced is not None else f"the {total:,} that the registry says"
            raise FetchError(f"{self.transfer.url}: more bytes come than {said}", address=self.transfer.url)
        self.count(len(block))
        return self.file.write(block)

    def flush(self) -> None:
        """Do nothing: the file is written when it is closed, and blocks are large."""


class _Broken(Exception):  # noqa: N818 (not an error for the user)
    """The connection ended before the file did; another one may go on."""


class _Complete(Exception):  # noqa: N818 (control flow through requests)
    """Nothing is left to ask for."""


def _total(content_range: str) -> int | None:
    match = re.fullmatch(r"bytes (?:\d+-\d+|\*)/(\d+)", content_range)
    return None if match is None else int(match[1])


def _first_words(error: BaseException) -> str:
    """The innermost reason, without the object addresses that requests wraps around it."""
    while True:
        inner = next((a for a in (getattr(error, "reason", None), *error.args) if isinstance(a, BaseException)), None)
        if inner is None:
            text = re.sub(r"<[^>]*>:? ?|HTTPS?Connection(?:Pool)?\([^)]*\):? ?", "", str(error))
            return text.strip()[:200]
        error = inner

"""A web server on localhost in a thread, for tests of downloads: ranges, broken connections, wrong answers."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Site:
    """What the server offers, and how it behaves.

    files       path -> content
    ranges      whether it answers Range with a part
    etags       path -> ETag, sent with every answer
    cuts        one for each answer to come: bytes of the body after which the connection breaks; none left: whole
    statuses    one for each request to come: answer this status instead; none left: 200 or 206
    redirects   path -> address
    heeds_if_range  whether a condition on the ETag is kept
    says_length whether it sends Content-Length (without it the end of the connection ends the file)
    asked       (path, Range header) of every request so far
    """

    address: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    ranges: bool = True
    etags: dict[str, str] = field(default_factory=dict)
    cuts: list[int] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)
    redirects: dict[str, str] = field(default_factory=dict)
    says_length: bool = True
    heeds_if_range: bool = True
    asked: list[tuple[str, str | None]] = field(default_factory=list)

    def url(self, path: str) -> str:
        return f"{self.address}{path}"


class _Handler(BaseHTTPRequestHandler):
    site: Site

    def do_GET(self) -> None:
        site, wanted = self.site, self.headers.get("Range")
        site.asked.append((self.path, wanted))
        if self.path in site.redirects:
            self.send_response(302)
            self.send_header("Location", site.redirects[self.path])
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        status = site.statuses.pop(0) if site.statuses else 0
        content = site.files.get(self.path)
        if status or content is None:
            self.send_error(status or 404)
            return
        etag = site.etags.get(self.path)
        condition = self.headers.get("If-Range")
        start = 0
        if site.ranges and wanted is not None and (condition is None or condition == etag or not site.heeds_if_range):
            match = re.fullmatch(r"bytes=(\d+)-", wanted)
            assert match is not None, wanted
            start = int(match[1])
            if start >= len(content):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(content)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        if etag is not None:
            self.send_header("ETag", etag)
        body = content[start:]
        if site.says_length:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        cut = site.cuts.pop(0) if site.cuts else len(body)
        with contextlib.suppress(OSError):  # the client may be gone
            self.wfile.write(body[:cut])
        self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        """Silence."""


@contextlib.contextmanager
def running_site() -> Iterator[Site]:
    """A site that answers while the block runs."""
    site = Site()
    handler = type("Handler", (_Handler,), {"site": site})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    site.address = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()
        thread.join()

"""A file with cuts that a slow server sends: shown from its first packet on, and again with each further one."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from fake_viser import Server
from sw_view.arriving import Arriving
from sw_view.view_command import show_arriving
from sw_view.viewer import Viewer

from splatwizard_core.api import BitstreamError, ContainerReader, UserInputError
from splatwizard_core.cli.main import main

GOLDEN = Path(__file__).parents[3] / "tests" / "golden"
DATA = (GOLDEN / "3dgs_packets_v1.swz").read_bytes()
ENDS = [cut["bytes"] for cut in ContainerReader(DATA).summary()["cuts"]]
WAIT = 60


class SlowSite:
    """A web server with one file, which sends no byte behind `send`."""

    def __init__(self, data: bytes) -> None:
        self._allowed, self._changed, self.breaks = 0, threading.Condition(), False
        site = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200 if self.path.endswith(".swz") else 404)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                sent = 0
                while sent < len(data) and not site.breaks:
                    upto = site.wait_for_more(sent)
                    self.wfile.write(data[sent : min(upto, sent + 100)])
                    sent = min(upto, sent + 100)

            def log_message(self, *_: object) -> None: ...

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server.server_port}/scene.swz"

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()

    def wait_for_more(self, sent: int) -> int:
        with self._changed:
            self._changed.wait_for(lambda: self._allowed > sent or self.breaks, WAIT)
            return max(self._allowed, sent)

    def send(self, upto: int, *, breaks: bool = False) -> None:
        with self._changed:
            self._allowed, self.breaks = upto, breaks
            self._changed.notify_all()


@pytest.fixture
def site():
    site = SlowSite(DATA)
    yield site
    site.send(len(DATA), breaks=True)
    site.close()


class Steps:
    """Waits until an Arriving has so many packets, or has ended."""

    def __init__(self) -> None:
        self._changed = threading.Condition()

    def __call__(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def until(self, condition) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, WAIT)


def test_each_packet_can_be_opened_when_it_is_whole(site, tmp_path):
    woken = Steps()
    arriving = Arriving(site.url, tmp_path, woken)
    for number, end in enumerate(ENDS, 1):
        site.send(end + 30)
        woken.until(lambda number=number: arriving.packets == number)
        assert arriving.file.read_bytes() == DATA[:end]
        if number < len(ENDS):
            assert arriving.told == f"{number} of 4 packets have arrived"
    woken.until(lambda: arriving.ended)
    assert arriving.told == ""


def test_the_viewer_draws_more_with_each_packet(site, monkeypatch):
    """Browsers see the first packet, then the whole: pictures of more and more Gaussians."""
    server, told = Server(), []
    client = None
    site.send(ENDS[0])

    def pump(self: Viewer, wait: float) -> None:
        nonlocal client
        client = client or server.connect()
        drawn(self, 0.01)  # the server has its turn
        line = self._sessions[client.client_id].told.content
        if not told or told[-1] != " ".join(line.splitlines()[:2]):
            told.append(" ".join(line.splitlines()[:2]))
        if wait > 1 and "packets have arrived" not in told[-1]:
            raise KeyboardInterrupt
        count = len([each for each in told if "packets have arrived" in each])
        site.send(ENDS[min(count, 3)])

    drawn = Viewer.pump
    monkeypatch.setattr(Viewer, "pump", pump)
    monkeypatch.setattr("sw_view.viewer.start_server", lambda host, port: server)
    assert main(["view", site.url]) == 0
    assert told[0].startswith("1 of 4 packets have arrived")
    assert "3 gaussians" in told[0]
    assert "24 gaussians" in told[-1]
    assert "packets" not in told[-1]
    assert client is not None
    assert len(client.scene.pictures) >= 3
    assert server.stopped


def test_a_connection_that_breaks_leaves_what_is_whole(site, tmp_path):
    woken = Steps()
    arriving = Arriving(site.url, tmp_path, woken)
    site.send(ENDS[1] + 5)
    woken.until(lambda: arriving.packets == 2)
    site.send(ENDS[1] + 5, breaks=True)
    woken.until(lambda: arriving.ended)
    assert arriving.told.startswith("2 of 4 packets arrived: ")
    server = Server()
    viewer = Viewer.__new__(Viewer)
    viewer.generation, viewer._shown_models, viewer.note = 0, {"a": None}, ""
    show_arriving(viewer, arriving, "a")
    assert viewer.generation == 1
    assert "2 of 4" in viewer.note
    assert not server.stopped


def test_what_is_no_file_is_refused(tmp_path):
    for data, error in ((b"<html>" * 50, BitstreamError), (DATA[:100], UserInputError), (b"", BitstreamError)):
        site = SlowSite(data)
        site.send(len(data))
        arriving = Arriving(site.url, tmp_path)
        with pytest.raises((error, BitstreamError), match=r"no \.swz file|truncated|ends at no|empty"):
            arriving.wait()
        other = Arriving(site.url.replace("scene.swz", "none"), tmp_path)
        with pytest.raises(UserInputError, match="404"):
            other.wait()
        site.close()


def test_a_file_without_cuts_is_shown_when_it_is_there(tmp_path):
    plain = (GOLDEN / "3dgs_r3_v1.swz").read_bytes()
    site = SlowSite(plain)
    site.send(len(plain))
    arriving = Arriving(site.url, tmp_path)
    arriving.wait()
    assert arriving.file.read_bytes() == plain
    site.close()


def test_one_address_alone(capsys):
    assert main(["view", "http://127.0.0.1:1/a.swz", "http://127.0.0.1:1/b.swz"]) == 2
    assert "one address is shown alone" in capsys.readouterr().err

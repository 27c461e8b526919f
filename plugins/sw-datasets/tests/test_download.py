"""Downloads against a server on localhost: resumed, verified, whole or not there."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from range_server import Site, running_site
from sw_datasets.downloads import download as module
from sw_datasets.downloads.download import download
from sw_datasets.errors import FetchError

from splatwizard_core.errors import CapabilityError

pytest.importorskip("pooch", reason="pip install 'sw-datasets[download]'")

CONTENT = np.random.default_rng(0).bytes(3_000_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()
PATH = "/data/scenes.zip"
CUT = 32 * module.CHUNK_BYTES  # whole chunks, so that nothing of what came is lost


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with running_site() as running:
        running.files[PATH] = CONTENT
        running.etags[PATH] = '"first"'
        yield running


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "downloads" / "scenes.zip"


class Waits(list[float]):
    """Records pauses instead of waiting."""

    def __call__(self, seconds: float) -> None:
        self.append(seconds)


def starts(site: Site) -> list[int]:
    """From which byte on each request asked."""
    return [int((wanted or "bytes=0-")[6:-1]) for _, wanted in site.asked]


def test_a_file_comes_whole_and_verified_and_leaves_nothing_beside_it(site: Site, target: Path):
    done = download(site.url(PATH), target, sha256=SHA256.upper(), size=len(CONTENT))
    assert target.read_bytes() == CONTENT
    assert (done.path, done.bytes, done.sha256, done.verified) == (target, len(CONTENT), SHA256, True)
    assert os.listdir(target.parent) == ["scenes.zip"]


def test_what_nobody_pinned_is_not_called_verified(site: Site, target: Path):
    done = download(site.url(PATH), target)
    assert (done.sha256, done.verified) == (SHA256, False)


def test_a_file_that_is_there_is_checked_and_not_asked_for_again(site: Site, target: Path):
    download(site.url(PATH), target)
    site.asked.clear()
    assert download(site.url(PATH), target, sha256=SHA256).verified
    assert site.asked == []


def test_a_connection_that_breaks_is_resumed_where_it_broke(site: Site, target: Path):
    site.cuts = [CUT, CUT // 2]
    notices: list[str] = []
    waits = Waits()
    download(site.url(PATH), target, sha256=SHA256, pause=waits, on_notice=notices.append)
    assert target.read_bytes() == CONTENT
    assert starts(site) == [0, CUT, CUT + CUT // 2]
    assert len(notices) == len(waits) == 2
    assert notices[0] == f"the connection broke: going on from {CUT:,} bytes"


def test_after_it_gave_up_the_next_call_goes_on(site: Site, target: Path):
    site.cuts = [CUT] + [0] * module.ATTEMPTS
    waits = Waits()
    with pytest.raises(FetchError, match=f"{CUT:,} bytes are kept, the same command goes on from there"):
        download(site.url(PATH), target, pause=waits)
    assert waits == [1, 2, 4, 8, 16]
    assert not target.exists()
    site.cuts, site.asked = [], []
    download(site.url(PATH), target, sha256=SHA256)
    assert starts(site) == [CUT]
    assert target.read_bytes() == CONTENT


def test_progress_sets_the_patience_back(site: Site, target: Path):
    site.cuts = [3 * module.CHUNK_BYTES] * 20  # more breaks than attempts in a row, each with some bytes
    download(site.url(PATH), target, sha256=SHA256, pause=Waits())
    assert len(site.asked) == 21


def test_a_killed_download_goes_on(site: Site, target: Path):
    """SIGKILL, then the same call: only what is missing is asked for."""
    program = (
        "import sys\nfrom pathlib import Path\nfrom sw_datasets.downloads.download import download\n"
        "import time\n"
        "download(sys.argv[1], Path(sys.argv[2]), on_notice=lambda text: print(text, flush=True), "
        "pause=lambda s: time.sleep(3600))\n"
    )
    site.cuts = [CUT]
    with subprocess.Popen(
        [sys.executable, "-c", program, site.url(PATH), str(target)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        said = process.stdout.readline()
        process.send_signal(signal.SIGKILL)
    assert f"{CUT:,} bytes" in said
    site.asked.clear()
    download(site.url(PATH), target, sha256=SHA256)
    assert starts(site) == [CUT]


def test_a_part_that_is_whole_already_is_only_renamed(site: Site, target: Path):
    site.cuts = [CUT] + [0] * module.ATTEMPTS
    with pytest.raises(FetchError):
        download(site.url(PATH), target, pause=Waits())
    target.with_name("scenes.zip.part").write_bytes(CONTENT)
    site.asked.clear()
    download(site.url(PATH), target, sha256=SHA256)
    assert site.asked == []


@pytest.mark.parametrize(("more", "asked"), [(b"", [len(CONTENT)]), (b"too much", [len(CONTENT) + 8, 0])])
def test_a_part_of_unknown_length_is_held_against_the_servers(site: Site, target: Path, more: bytes, asked: list[int]):
    target.parent.mkdir()
    target.with_name("scenes.zip.part").write_bytes(CONTENT + more)
    target.with_name("scenes.zip.part.json").write_text(json.dumps({"url": site.url(PATH), "total": None}))
    download(site.url(PATH), target, sha256=SHA256, pause=Waits())
    assert starts(site) == asked


def test_a_file_that_changed_meanwhile_is_never_joined_with_its_former_part(site: Site, target: Path):
    site.cuts = [CUT] + [0] * module.ATTEMPTS
    with pytest.raises(FetchError):
        download(site.url(PATH), target, pause=Waits())
    site.cuts = []
    site.files[PATH] = changed = CONTENT[::-1]
    site.etags[PATH] = '"second"'
    notices: list[str] = []
    download(site.url(PATH), target, on_notice=notices.append)
    assert target.read_bytes() == changed
    assert any("from the beginning" in notice for notice in notices)


def test_without_an_etag_another_length_starts_over(site: Site, target: Path):
    site.etags.clear()
    site.cuts = [CUT] + [0] * module.ATTEMPTS
    with pytest.raises(FetchError):
        download(site.url(PATH), target, pause=Waits())
    site.cuts = []
    site.files[PATH] = longer = CONTENT[::-1] + b"more"
    download(site.url(PATH), target, pause=Waits())
    assert target.read_bytes() == longer


def test_a_part_of_another_address_is_not_gone_on_with(site: Site, target: Path):
    site.cuts = [CUT] + [0] * module.ATTEMPTS
    with pytest.raises(FetchError):
        download(site.url(PATH), target, pause=Waits())
    site.cuts = []
    site.files["/mirror.zip"] = b"another file"
    download(site.url("/mirror.zip"), target)
    assert target.read_bytes() == b"another file"


@pytest.mark.parametrize("note", [b"", b"{", b"[]", b'{"url": 3, "who": 1}', b"\xff"])
def test_a_damaged_note_costs_the_part_and_nothing_else(site: Site, target: Path, note: bytes):
    target.parent.mkdir()
    target.with_name("scenes.zip.part").write_bytes(b"of something")
    target.with_name("scenes.zip.part.json").write_bytes(note)
    download(site.url(PATH), target, sha256=SHA256)
    assert starts(site) == [0]


def test_a_server_without_ranges_starts_over_and_says_so(site: Site, target: Path):
    site.ranges = False
    site.cuts = [CUT]
    notices: list[str] = []
    download(site.url(PATH), target, sha256=SHA256, pause=Waits(), on_notice=notices.append)
    assert target.read_bytes() == CONTENT
    assert any("cannot resume" in notice for notice in notices)


def test_a_server_that_says_no_length_is_read_to_its_end(site: Site, target: Path):
    site.says_length = False
    assert download(site.url(PATH), target, sha256=SHA256).verified


def test_a_redirection_is_followed(site: Site, target: Path):
    site.redirects["/latest"] = PATH
    assert download(site.url("/latest"), target, sha256=SHA256).verified


def test_a_wrong_checksum_is_named_and_the_file_kept_apart(site: Site, target: Path):
    wrong = "0" * 64
    with pytest.raises(FetchError, match=f"SHA-256 is {SHA256}, pinned is {wrong}"):
        download(site.url(PATH), target, sha256=wrong)
    site.asked.clear()
    assert download(site.url(PATH), target, sha256=SHA256).verified  # a mistyped pin did not cost the download
    assert site.asked == []


def test_another_size_than_the_registry_says_is_refused_before_it_comes(site: Site, target: Path):
    with pytest.raises(FetchError, match="offers 3,000,000 bytes, the registry says 5"):
        download(site.url(PATH), target, size=5)
    assert os.listdir(target.parent) == []


def test_what_is_not_there_says_so_at_once(site: Site, target: Path):
    waits = Waits()
    with pytest.raises(FetchError, match=r"nowhere\.zip: the server answers 404 Not Found") as caught:
        download(site.url("/nowhere.zip"), target, pause=waits)
    assert (waits, len(site.asked), caught.value.exit_status) == ([], 1, 1)
    assert os.listdir(target.parent) == []


def test_a_busy_server_is_asked_again(site: Site, target: Path):
    site.statuses = [503, 429]
    waits = Waits()
    download(site.url(PATH), target, sha256=SHA256, pause=waits)
    assert waits == [1, 2]


def test_nobody_there_is_said_in_one_line(target: Path):
    with pytest.raises(FetchError, match="refused") as caught:
        download("http://127.0.0.1:9/x.zip", target, pause=Waits())
    assert "\n" not in str(caught.value)
    assert "0x" not in str(caught.value)


def test_too_little_space_is_said_before_a_byte_is_written(site: Site, target: Path, monkeypatch: pytest.MonkeyPatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 0, 5_000_000))
    with pytest.raises(FetchError, match="not enough space"):
        download(site.url(PATH), target, room_for=lambda size: 2 * size)
    assert os.listdir(target.parent) == []
    assert download(site.url(PATH), target, room_for=lambda size: size, sha256=SHA256).verified


def test_a_disk_that_fills_meanwhile_keeps_what_came(site: Site, target: Path, monkeypatch: pytest.MonkeyPatch):
    written = module._Sink.write

    def write(sink, block):
        if sink.file.tell() >= CUT:
            raise OSError(28, "No space left on device")
        return written(sink, block)

    monkeypatch.setattr(module._Sink, "write", write)
    with pytest.raises(FetchError, match=f"the disk is full; {CUT:,} bytes are kept"):
        download(site.url(PATH), target)
    monkeypatch.undo()
    download(site.url(PATH), target, sha256=SHA256)
    assert starts(site) == [0, CUT]


def test_progress_and_time_left_are_shown(
    site: Site, target: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("splatwizard_core.base.progress.Bar._interval", 0.0)
    monkeypatch.setattr(module, "CHUNK_BYTES", 100_000)
    download(site.url(PATH), target)
    shown = capsys.readouterr().err
    assert "download scenes.zip: 1/3" in shown
    assert "left" in shown
    assert "MB/s" in shown


def test_without_pooch_it_names_what_to_install(site: Site, target: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(CapabilityError, match=r"pip install 'sw-datasets\[download\]'"):
        download(site.url(PATH), target)
    assert site.asked == []


def test_an_interrupted_download_keeps_what_came(site: Site, target: Path):
    """Ctrl-C in the pause after a break."""
    site.cuts = [CUT]

    def interrupt(seconds: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download(site.url(PATH), target, pause=interrupt)
    assert target.with_name("scenes.zip.part").stat().st_size == CUT
    download(site.url(PATH), target, sha256=SHA256, pause=interrupt)  # which goes on at once
    assert starts(site) == [0, CUT]


def test_an_answer_without_length_ends_at_the_size_of_the_registry(site: Site, target: Path):
    site.says_length = False
    with pytest.raises(FetchError, match="more bytes come than the 100,000 that the registry says"):
        download(site.url(PATH), target, size=100_000)
    assert target.with_name("scenes.zip.part").stat().st_size <= 100_000


def test_a_part_of_another_version_is_not_appended(site: Site, target: Path):
    """A server that answers If-Range with a part all the same: its ETag tells that the file is another one."""
    site.cuts = [CUT] + [0] * module.ATTEMPTS
    with pytest.raises(FetchError):
        download(site.url(PATH), target, pause=Waits())
    site.cuts, site.heeds_if_range = [], False
    site.files[PATH], site.etags[PATH] = CONTENT[::-1], '"second"'
    download(site.url(PATH), target, pause=Waits())
    assert target.read_bytes() == CONTENT[::-1]

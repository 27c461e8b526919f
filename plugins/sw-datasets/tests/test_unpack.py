"""Archives from strangers: scenes come out whole, or nothing does."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import stat
import tarfile
import zipfile
from collections import namedtuple
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sw_datasets.downloads import unpack as module
from sw_datasets.downloads.unpack import unpack_scenes, unpack_whole
from sw_datasets.errors import FetchError

from splatwizard_core.errors import DiskFullError

SCENES = {
    "360/garden/images/a b.jpg": b"a",
    "360/garden/images/über/c.jpg": b"cc",
    "360/garden/sparse/0/cameras.bin": b"ccc",
    "360/room/images/r.jpg": b"r",
    "360/room/sparse/0/cameras.bin": b"rr",
    "360/room/garden/notes.txt": b"a folder of the other scene's name, without what a scene needs",
    "360/README.txt": b"not a scene",
    "__MACOSX/360/garden/images/._a b.jpg": b"junk",
    "360/garden/.DS_Store": b"junk",
}
NEEDS = ("images", "sparse")


def make_zip(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def make_tar(path: Path, files: dict[str, bytes], mode: str = "w") -> Path:
    with tarfile.open(path, mode) as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return path


MAKERS = {
    "zip": make_zip,
    "tar": make_tar,
    "tar.gz": lambda path, files: make_tar(path, files, "w:gz"),
    "tar.bz2": lambda path, files: make_tar(path, files, "w:bz2"),
    "tar.xz": lambda path, files: make_tar(path, files, "w:xz"),
}


def tree(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", MAKERS)
def test_wanted_scenes_come_out_and_nothing_else(kind: str, tmp_path: Path):
    archive = MAKERS[kind](tmp_path / f"a.{kind}", SCENES)
    done = unpack_scenes(archive, tmp_path / "data", {"garden": ["garden"]}, NEEDS)
    assert done["garden"].path == tmp_path / "data" / "garden"
    assert tree(tmp_path / "data") == {
        "garden/images/a b.jpg": b"a",
        "garden/images/über/c.jpg": b"cc",
        "garden/sparse/0/cameras.bin": b"ccc",
    }
    assert done["garden"].files["images/über/c.jpg"] == (2, hashlib.sha256(b"cc").hexdigest())
    assert len(done["garden"].files) == 3


def test_several_scenes_come_out_of_one_pass(tmp_path: Path):
    archive = make_tar(tmp_path / "a.tar.gz", SCENES, "w:gz")
    done = unpack_scenes(archive, tmp_path / "data", {"garden": ["garden"], "room": ["room"]}, NEEDS)
    assert set(done) == {"garden", "room"}
    assert (tmp_path / "data" / "room" / "garden" / "notes.txt").is_file()
    assert sorted(os.listdir(tmp_path / "data")) == ["garden", "room"]


def test_a_scene_may_lie_at_the_top_and_under_its_prefixed_name(tmp_path: Path):
    archive = make_zip(tmp_path / "a.zip", {"scan24/images/0.png": b"0", "scan24/sparse/x": b"1"})
    done = unpack_scenes(archive, tmp_path / "dtu", {"24": ["scan24", "24"]}, NEEDS)
    assert done["24"].path == tmp_path / "dtu" / "scan24"


def test_two_candidates_are_not_guessed_between(tmp_path: Path):
    both = {f"{top}/garden/{inner}": b"x" for top in ("old", "new") for inner in ("images/a.jpg", "sparse/b")}
    with pytest.raises(FetchError, match="could both be scene 'garden'"):
        unpack_scenes(make_zip(tmp_path / "a.zip", both), tmp_path / "data", {"garden": ["garden"]}, NEEDS)


def test_an_archive_without_the_scene_says_so(tmp_path: Path):
    archive = make_zip(tmp_path / "a.zip", SCENES)
    with pytest.raises(FetchError, match="holds no folder 'kitchen' with images, sparse"):
        unpack_scenes(archive, tmp_path / "data", {"kitchen": ["kitchen"]}, NEEDS)
    assert os.listdir(tmp_path) == ["a.zip"]


def test_a_whole_archive_goes_into_one_new_folder(tmp_path: Path):
    archive = make_zip(tmp_path / "a.zip", {"x/y": b"1", "z": b"2"})
    unpack_whole(archive, tmp_path / "data" / "models")
    assert tree(tmp_path / "data" / "models") == {"x/y": b"1", "z": b"2"}
    with pytest.raises(FetchError, match="is there already"):
        unpack_whole(archive, tmp_path / "data" / "models")


HOSTILE_NAMES = ["../evil", "a/../../evil", "/etc/evil", "a/b/../../../evil", "C:/evil", "..\\evil", "a\nb", ".."]


@pytest.mark.parametrize("name", HOSTILE_NAMES)
@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_names_that_lead_out_are_refused(kind: str, name: str, tmp_path: Path):
    (tmp_path / "in").mkdir()
    archive = MAKERS[kind](tmp_path / "in" / f"a.{kind}", {"good": b"1", name: b"evil"})
    with pytest.raises(FetchError, match="leads out of the folder or cannot be a file name; refused"):
        unpack_whole(archive, tmp_path / "out" / "data")
    assert sorted(os.listdir(tmp_path)) == ["in"]


@pytest.mark.parametrize(
    "kind",
    [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.GNUTYPE_SPARSE],
)
def test_links_devices_and_sparse_files_in_a_tar_are_refused(kind: bytes, tmp_path: Path):
    with tarfile.open(tmp_path / "a.tar", "w") as archive:
        info = tarfile.TarInfo("link")
        info.type, info.linkname = kind, "../../etc/passwd"
        archive.addfile(info)
    with pytest.raises(FetchError, match=r"refused|damaged"):
        unpack_whole(tmp_path / "a.tar", tmp_path / "data")
    assert os.listdir(tmp_path) == ["a.tar"]


def test_links_and_encrypted_members_of_a_zip_are_refused(tmp_path: Path):
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "link.zip", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(FetchError, match="a link or a device; refused"):
        unpack_whole(tmp_path / "link.zip", tmp_path / "data")
    content = bytearray(make_zip(tmp_path / "secret.zip", {"a": b"1"}).read_bytes())
    for signature, flags in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        content[content.index(signature) + flags] |= 1
    (tmp_path / "secret.zip").write_bytes(content)
    with pytest.raises(FetchError, match="is encrypted; refused"):
        unpack_whole(tmp_path / "secret.zip", tmp_path / "data")
    assert not (tmp_path / "data").exists()


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_equal_names_are_refused(kind: str, tmp_path: Path):
    if kind == "zip":
        with zipfile.ZipFile(tmp_path / "a", "w") as archive:
            archive.writestr("x", b"1")
            archive.writestr("./x", b"2")
    else:
        with tarfile.open(tmp_path / "a", "w") as archive:
            archive.addfile(tarfile.TarInfo("x"))
            archive.addfile(tarfile.TarInfo("./x"))
    with pytest.raises(FetchError, match="is in it twice; refused"):
        unpack_whole(tmp_path / "a", tmp_path / "data")


@pytest.mark.parametrize("files", [{"x": b"1", "x/y": b"2"}, {"x/y": b"2", "x": b"1"}])
def test_a_file_that_is_also_a_folder_is_refused(files: dict[str, bytes], tmp_path: Path):
    with pytest.raises(FetchError, match="a file and a folder at once"):
        unpack_whole(make_tar(tmp_path / "a.tar", files), tmp_path / "data")
    assert os.listdir(tmp_path) == ["a.tar"]


@pytest.mark.parametrize("kind", ["zip", "tar.gz", "tar.xz"])
def test_bombs_are_refused_before_anything_is_written(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "GRACE_BYTES", 1 << 16)
    archive = MAKERS[kind](tmp_path / f"a.{kind}", {f"zeros{i}": bytes(5_000_000) for i in range(4)})
    assert archive.stat().st_size < 100_000
    with pytest.raises(FetchError, match="a decompression bomb; refused"):
        unpack_whole(archive, tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_too_many_members_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "MAX_MEMBERS", 10)
    archive = make_zip(tmp_path / "a.zip", {f"{i}": b"" for i in range(11)})
    with pytest.raises(FetchError, match="bomb"):
        unpack_whole(archive, tmp_path / "data")


@pytest.mark.parametrize("kind", [tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK])
def test_a_tar_header_that_claims_gigabytes_is_refused_unread(kind: bytes, tmp_path: Path):
    info = tarfile.TarInfo("x")
    info.type, info.size = kind, 6 << 30
    (tmp_path / "a.tar").write_bytes(info.tobuf(tarfile.GNU_FORMAT) + bytes(1024))
    with pytest.raises(FetchError, match=r"claims 6,442,450,944 bytes|no zip or tar"):
        unpack_whole(tmp_path / "a.tar", tmp_path / "data")


def test_a_tar_size_below_nothing_ends_in_an_error(tmp_path: Path):
    info = tarfile.TarInfo("x")
    header = bytearray(info.tobuf(tarfile.GNU_FORMAT))
    header[124:136] = b"\xff" * 12  # -1 in base 256
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    (tmp_path / "a.tar").write_bytes(bytes(header) + bytes(1024))
    with pytest.raises(FetchError):
        unpack_whole(tmp_path / "a.tar", tmp_path / "data")


def test_a_member_longer_than_announced_stops(tmp_path: Path):
    """A zip whose directory says 3 bytes of a member that unpacks to more."""
    content = bytearray(make_zip(tmp_path / "a.zip", {"x": b"abcdef"}).read_bytes())
    for signature, size in ((b"PK\3\4", 22), (b"PK\1\2", 24)):
        at = content.index(signature) + size
        content[at : at + 4] = (3).to_bytes(4, "little")
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(FetchError, match=r"damaged|not as long"):
        unpack_whole(tmp_path / "a.zip", tmp_path / "data")
    assert os.listdir(tmp_path) == ["a.zip"]


@pytest.mark.parametrize("content", [b"", b"<html>Sign in</html>", bytes(100), b"PK\5\6" + bytes(18)])
def test_what_is_no_archive_is_told_apart(content: bytes, tmp_path: Path):
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(FetchError, match=r"no zip or tar archive|holds no file"):
        unpack_whole(tmp_path / "a.zip", tmp_path / "data")


@pytest.mark.parametrize("kind", MAKERS)
def test_a_truncated_archive_leaves_nothing(kind: str, tmp_path: Path):
    files = {f"{i}.bin": os.urandom(30_000) for i in range(5)}
    archive = MAKERS[kind](tmp_path / f"a.{kind}", files)
    archive.write_bytes(archive.read_bytes()[:100_000])
    with pytest.raises(FetchError):
        unpack_whole(archive, tmp_path / "data")
    assert os.listdir(tmp_path) == [archive.name]


def test_too_little_space_is_said_before_a_byte_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 0, 1))
    with pytest.raises(FetchError, match="not enough space"):
        unpack_whole(make_zip(tmp_path / "a.zip", {"x": b"12"}), tmp_path / "data")


def test_a_full_disk_half_way_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    written = module._write

    def write(stream, target, member, archive, count):
        if member.parts[-1] == "r.jpg":
            raise OSError(28, "No space left on device", str(target))
        return written(stream, target, member, archive, count)

    monkeypatch.setattr(module, "_write", write)
    archive = make_zip(tmp_path / "a.zip", SCENES)
    with pytest.raises(DiskFullError, match="the disk is full"):
        unpack_scenes(archive, tmp_path / "data", {"garden": ["garden"], "room": ["room"]}, NEEDS)
    assert os.listdir(tmp_path / "data") == []


@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_damage_is_a_fetch_error_and_writes_nothing_outside(kind: str, data: st.DataObject, tmp_path: Path):
    work = tmp_path / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    archive = MAKERS[kind](work / f"a.{kind}", SCENES)
    content = bytearray(archive.read_bytes())
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    archive.write_bytes(content)
    try:
        unpack_whole(archive, work / "data")
    except FetchError:
        assert os.listdir(work) == [archive.name]
    else:
        assert sorted(os.listdir(work)) == sorted([archive.name, "data"])
    assert os.listdir(tmp_path) == ["work"]


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_zip_members_that_unpack_in_one_read_are_refused(method: int, tmp_path: Path):
    """zipfile hands a block of bzip2 to its decoder without a limit: 1.5 kB unpacked 4.1 GB in one read."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w", method) as archive:
        archive.writestr("x", bytes(1000))
    with pytest.raises(FetchError, match=r"'x' is compressed by (bzip2|lzma): pack it again with deflate"):
        unpack_whole(tmp_path / "a.zip", tmp_path / "data")


def pax_header(kind: bytes, size: int) -> bytes:
    """An extended header of about `size` bytes of tiny entries."""
    entry = [b"8 %04x=\n" % i for i in range(size // 8)]
    info = tarfile.TarInfo("h")
    info.type, info.size = kind, len(b"".join(entry))
    return info.tobuf(tarfile.USTAR_FORMAT) + b"".join(entry) + bytes(-info.size % 512)


@pytest.mark.parametrize(
    ("headers", "reason"),
    [
        ([pax_header(tarfile.XHDTYPE, 1 << 17)], "a header claims"),
        ([pax_header(tarfile.XHDTYPE, 512)] * 9, "9 extended headers in a row"),
        ([pax_header(tarfile.XGLTYPE, 1024), tarfile.TarInfo("__MACOSX/f").tobuf()] * 5, "bytes of global ones"),
    ],
)
def test_tar_headers_that_fill_the_memory_are_refused(headers: list[bytes], reason: str, tmp_path: Path):
    content = tarfile.TarInfo("first").tobuf() + b"".join(headers) + tarfile.TarInfo("last").tobuf() + bytes(1024)
    with tarfile.open(tmp_path / "ordinary.tar", "w", format=tarfile.PAX_FORMAT) as archive:
        archive.addfile(tarfile.TarInfo("\u00fc" * 110))  # a long name needs such a header
    assert len(unpack_whole(tmp_path / "ordinary.tar", tmp_path / "ordinary").files) == 1
    (tmp_path / "a.tar").write_bytes(content)
    with pytest.raises(FetchError, match=reason):
        unpack_whole(tmp_path / "a.tar", tmp_path / "data")


def test_junk_and_folders_are_counted_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "MAX_MEMBERS", 10)
    files = {"x": b"1"} | {f"__MACOSX/{i}": b"" for i in range(10)}
    with pytest.raises(FetchError, match="11 entries of 1 bytes so far"):
        unpack_whole(make_tar(tmp_path / "a.tar", files), tmp_path / "data")
    monkeypatch.setattr(module, "GRACE_BYTES", 0)
    with pytest.raises(FetchError, match="bomb"):
        unpack_whole(make_tar(tmp_path / "b.tar.gz", {"__MACOSX/z": bytes(500_000), "x": b""}, "w:gz"), tmp_path / "b")


def test_a_tar_of_a_folder_itself_unpacks(tmp_path: Path):
    """As `tar -C FOLDER -czf a.tar.gz .` writes it."""
    (tmp_path / "in" / "images").mkdir(parents=True)
    (tmp_path / "in" / "images" / "a.png").write_bytes(b"a")
    with tarfile.open(tmp_path / "a.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "in", arcname=".")
    unpack_whole(tmp_path / "a.tar.gz", tmp_path / "data")
    assert tree(tmp_path / "data") == {"images/a.png": b"a"}

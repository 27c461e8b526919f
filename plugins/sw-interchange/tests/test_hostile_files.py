"""A file from a stranger is refused in one or two lines, before anything large is allocated, or it is a sound scene."""

import gzip
import io
import json
import os
import pickle
import struct
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator

import numpy as np
import pytest
from interchange_files import Sample, ksplat_file, mutants, random_scene, samples
from sw_gaussians.ply import load_ply
from sw_interchange import Limits, decode, encode, gltf, read, write

from splatwizard_core.api import SceneError, SplatwizardError, UserInputError

LIMITS = Limits(max_gaussians=1 << 20, max_output_bytes=1 << 28)
MEMORY = 256 << 20
FLIPS = 1000
SLOW_TO_OPEN = {"sog": 300, "spz": 600, "spz-v4": 600, "ksplat": 600}
"""Fewer of these: eight images, or a compressor, for each."""


@pytest.fixture(scope="module")
def sound() -> dict[str, Sample]:
    return samples()


def spz_head(version: int = 3, count: int = 5, degree: int = 1, bits: int = 12, flags: int = 0, more: int = 0) -> bytes:
    return b"NGSP" + struct.pack("<IIBBBB", version, count, degree, bits, flags, more)


def spz4(count: int, *, streams: int = 5, start: int = 32, table: list[int] | None = None, rest: bytes = b"") -> bytes:
    head = spz_head(4, count, 0, more=streams) + struct.pack("<I", start) + bytes(12)
    return head + struct.pack(f"<{len(table or [])}Q", *(table or [])) + rest


def sog_with(changes: dict[str, object] | None = None, **files: bytes | None) -> bytes:
    """A small .sog with other entries of meta.json ("means.mins": ...) and other files; None removes one."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(encode(random_scene(5, 1), "sog")[0])) as old:
        content: dict[str, bytes | None] = {name: old.read(name) for name in old.namelist()}
    meta = json.loads(content["meta.json"] or b"")
    for path, value in (changes or {}).items():
        *parts, last = path.split(".")
        place = meta
        for part in parts:
            place = place[part]
        place[last] = value
    content["meta.json"] = json.dumps(meta).encode()
    content |= {name.replace("__", "."): data for name, data in files.items()}
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new:
        for name, data in content.items():
            if data is not None:
                new.writestr(name, data)
    return buffer.getvalue()


def huge_webp() -> bytes:
    bits = (16382 | 16382 << 14).to_bytes(4, "little")
    body = b"VP8L" + struct.pack("<I", 6) + b"\x2f" + bits + b"\0"
    return b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP" + body


def lossy_webp() -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.new("RGB", (4, 4)).save(buffer, "WEBP", quality=50)
    return buffer.getvalue()


def one_colour(side: int) -> bytes:
    """A .sog of five pictures of one colour, each of few bytes, which claim a Gaussian for each of their texels."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.new("RGBA", (side, side), (9, 9, 9, 255)).save(buffer, "WEBP", lossless=True, exact=True)
    names = ("means_l", "means_u", "scales", "quats", "sh0")
    return sog_with({"count": side**2, "shN": None}, **{f"{name}__webp": buffer.getvalue() for name in names})


def glb(document: object, blob: bytes = b"") -> bytes:
    text = json.dumps(document).encode() if not isinstance(document, bytes) else document
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf_with(place: str, value: object) -> bytes:
    data = encode(random_scene(5, 1), "gltf")[0]
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    *parts, last = [int(p) if p.isdigit() else p for p in place.split(".")]
    part = document
    for each in parts:
        part = part[each]
    part[last] = value
    return glb(document, data[28 + size :])


def nested_gltf(depth: int) -> bytes:
    nodes = [{"children": [i + 1]} for i in range(depth)] + [{"children": [0]}]
    return glb({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes})


def ksplat_with(offset: int, raw: bytes) -> bytes:
    data = bytearray(ksplat_file(2, 1, 1))
    data[offset : offset + len(raw)] = raw
    return bytes(data)


PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n"
ZEROS = zlib.compressobj(9, zlib.DEFLATED, 31)
GZIP_BOMB = ZEROS.compress(spz_head(count=1) + bytes(1 << 26)) + ZEROS.flush()


def spz_of_zeros(count: int, degree: int) -> bytes:
    row = 20 + 3 * {0: 0, 3: 15}[degree]
    return gzip.compress(spz_head(count=count, degree=degree) + bytes(row * count))


def zstd_bomb() -> bytes:
    import zstandard

    frame = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1 << 26))
    return spz4(1, table=[len(frame), 9, 0, 1, 0, 3, 0, 3, 0, 4], rest=frame)


def rle_bomb(blocks: int) -> bytes:
    """A frame of blocks of four bytes that stand for 128 KiB each, and no size of the whole."""
    block = 1 << 17
    frame = struct.pack("<IBB", 0xFD2FB528, 0, 7 << 3)  # a window of 2^17
    frame += (struct.pack("<I", block << 3 | 1 << 1)[:3] + b"\7") * blocks
    frame += struct.pack("<I", 1)[:3]  # the last one, of no bytes
    return spz4(1, table=[len(frame), 9, 0, 1, 0, 3, 0, 3, 0, 4], rest=frame)


def shared_gltf(primitives: int, nodes: int) -> bytes:
    """Nodes that all show one mesh, whose primitives all name the same accessors."""
    data = encode(random_scene(5, 1), "gltf")[0]
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    document["meshes"][0]["primitives"] *= primitives
    document["nodes"] = [{"mesh": 0}] * nodes
    document["scenes"] = [{"nodes": list(range(nodes))}]
    return glb(document, data[28 + size :])


BAD = {
    "gltf that reads its bytes again": (shared_gltf(40, 1), "gltf"),
    "spz of many extensions": (gzip.compress(spz_head(count=1, degree=0, flags=2) + bytes(20 + 8 * 65)), "spz"),
    "nothing": (b"", None),
    "text": (b"hello", None),
    "ply without an end": (PLY, "ply"),
    "ply with a negative count": (PLY.replace(b"2\n", b"-2\n") + b"end_header\n", "ply"),
    "ply with half a Gaussian": (PLY.replace(b"2\n", b"2.5\n") + b"end_header\n", "ply"),
    "ply with too many": (PLY.replace(b" 2\n", b" 999999999999\n") + b"end_header\n", "ply"),
    "ply with a property twice": (PLY + b"property float x\nend_header\n" + bytes(99), "ply"),
    "ply with a list": (PLY + b"property list uchar int y\nend_header\n" + bytes(99), "ply"),
    "ply with an unknown type": (PLY + b"property quad y\nend_header\n" + bytes(99), "ply"),
    "ply with many lists ahead": (b"ply\nformat ascii 1.0\nelement face 99999999\nproperty list uchar int i\n"
                                  b"element vertex 1\nproperty float x\nend_header\n" + bytes(999), "ply"),
    "splat of 33 bytes": (bytes(33), "splat"),
    "splat of no bytes": (b"", "splat"),
    "splat of a negative scale alone": (struct.pack("<6f", 0, 0, 0, -1, 1, 1) + bytes(8), "splat"),
    "spz of no Gaussian": (gzip.compress(spz_head(count=0)), "spz"),
    "spz of 2^32 - 1": (gzip.compress(spz_head(count=2**32 - 1) + bytes(999)), "spz"),
    "spz of 2^31 - 1": (gzip.compress(spz_head(count=2**31 - 1) + bytes(999)), "spz"),
    "spz of degree 5": (gzip.compress(spz_head(degree=5) + bytes(999)), "spz"),
    "spz of version 5": (gzip.compress(spz_head(version=5) + bytes(999)), "spz"),
    "spz of 25 fractional bits": (gzip.compress(spz_head(bits=25) + bytes(999)), "spz"),
    "spz with a tree": (gzip.compress(spz_head(flags=0x80) + bytes(999)), "spz"),
    "spz that is short": (gzip.compress(spz_head() + bytes(99)), "spz"),
    "spz that ends early": (encode(random_scene(50, 3), "spz")[0][:-200], "spz"),
    "spz of noise": (b"\x1f\x8b\x08" + bytes(range(200)), "spz"),
    "spz with an extension that is cut off": (
        gzip.compress(spz_head(count=1, degree=0, flags=2) + bytes(20) + struct.pack("<II", 1, 2**32 - 1)), "spz"),
    "spz of a million zeros": (spz_of_zeros(1 << 20, 0), "spz"),
    "spz of SH of zeros": (spz_of_zeros(1 << 18, 3), "spz"),
    "spz4 without streams": (spz4(5, streams=0, rest=bytes(99)), "spz"),
    "spz4 with 255 streams": (spz4(5, streams=255, rest=bytes(99)), "spz"),
    "spz4 with a table before the header's end": (spz4(5, start=8, rest=bytes(199)), "spz"),
    "spz4 with a table beyond the end": (spz4(5, start=2**32 - 1, rest=bytes(199)), "spz"),
    "spz4 with too many": (spz4(2**31 - 1, rest=bytes(199)), "spz"),
    "spz4 of other sizes": (spz4(5, table=[1, 2**60] * 5, rest=bytes(5)), "spz"),
    "spz4 bomb": (zstd_bomb(), "spz"),
    "spz4 bomb of 16 kB": (rle_bomb(4000), "spz"),
    "compressed ply without chunks": (encode(random_scene(5, 1), "compressed-ply")[0].replace(
        b"element chunk 1", b"element chunk 0"), "compressed-ply"),
    "compressed ply with other SH": (encode(random_scene(5, 1), "compressed-ply")[0].replace(
        b"f_rest_8", b"f_more_8"), "compressed-ply"),
    "ksplat that is short": (ksplat_file(2, 1, 1)[:-1], "ksplat"),
    "ksplat of 4095 bytes": (ksplat_file(2, 1, 1)[:4095], "ksplat"),
    "ksplat of level 3": (ksplat_with(20, b"\3"), "ksplat"),
    "ksplat of 2^32 - 1 sections": (ksplat_with(4, b"\xff" * 8), "ksplat"),
    "ksplat of degree 3": (ksplat_with(4096 + 40, b"\3"), "ksplat"),
    "ksplat with a count that is too large": (ksplat_with(4096 + 4, b"\xff" * 4), "ksplat"),
    "ksplat with other buckets": (ksplat_with(4096 + 36, b"\2"), "ksplat"),
    "sog that is no archive": (b"PK\3\4" + bytes(200), "sog"),
    "sog with a file without a name": (sog_with(quats__webp=None).replace(b"scales.webp", b"\0cales.webp"), "sog"),
    "sog without meta.json": (sog_with(meta__json=None), "sog"),
    "sog without an image": (sog_with(quats__webp=None), "sog"),
    "sog with a path": (sog_with({"quats.files": ["../quats.webp"]}), "sog"),
    "sog with an absolute path": (sog_with({"quats.files": ["/etc/passwd"]}), "sog"),
    "sog with an address": (sog_with({"quats.files": ["http:x"]}), "sog"),
    "sog with a number that is none": (sog_with(meta__json=b'{"version": 2, "count": NaN}'), "sog"),
    "sog with deep brackets": (sog_with(meta__json=b"[" * 100_000), "sog"),
    "sog of 2^40": (sog_with({"count": 2**40}), "sog"),
    "sog of more than its images hold": (sog_with({"count": 17}), "sog"),
    "sog of version 3": (sog_with({"version": 3}), "sog"),
    "sog with a short codebook": (sog_with({"scales.codebook": list(range(3))}), "sog"),
    "sog with a codebook of words": (sog_with({"scales.codebook": ["a"] * 256}), "sog"),
    "sog with infinite bounds": (sog_with({"means.maxs": [1, 1, 1e300]}), "sog"),
    "sog with bounds the wrong way": (sog_with({"means.maxs": [-99, 1, 1]}), "sog"),
    "sog of degree 4": (sog_with({"shN.bands": 4}), "sog"),
    "sog with another palette": (sog_with({"shN.count": 65536}), "sog"),
    "sog with a huge image": (sog_with(quats__webp=huge_webp()), "sog"),
    "sog with huge images alone": (sog_with({"count": 1 << 20}, **{f"{n}__webp": huge_webp() for n in (
        "means_l", "means_u", "scales", "quats", "sh0")}), "sog"),
    "sog of one colour": (one_colour(1024), "sog"),
    "sog with a lossy image": (sog_with(quats__webp=lossy_webp()), "sog"),
    "sog with a damaged image": (sog_with(quats__webp=huge_webp().replace(b"\xfe\xbf", b"\3\0")), "sog"),
    "sog bomb": (sog_with(more=bytes(1 << 26)), "sog"),
    "gltf without splats": (glb({"asset": {"version": "2.0"}, "scenes": [{}]}), "gltf"),
    "gltf of text": (b'{"asset": {"version": "2.0"}}', "gltf"),
    "gltf that is no document": (glb([]), "gltf"),
    "gltf with deep brackets": (glb(b"[" * 100_000), "gltf"),
    "gltf with an accessor beyond its buffer": (gltf_with("accessors.0.count", 6), "gltf"),
    "gltf with 2^40 rows": (gltf_with("accessors.0.count", 2**39), "gltf"),
    "gltf with a stride of nothing": (gltf_with("bufferViews.0.byteStride", 1), "gltf"),
    "gltf with a view beyond the end": (gltf_with("bufferViews.0.byteOffset", 2**32), "gltf"),
    "gltf with a negative offset": (gltf_with("bufferViews.1.byteOffset", -4), "gltf"),
    "gltf with another file": (gltf_with("buffers.0.uri", "/etc/passwd"), "gltf"),
    "gltf with sparse rows": (gltf_with("accessors.0.sparse", {}), "gltf"),
    "gltf that shears": (gltf_with("nodes.0.scale", [1, 2, 1]), "gltf"),
    "gltf that mirrors": (gltf_with("nodes.0.scale", [-1, 1, 1]), "gltf"),
    "gltf that turns everything inside out": (gltf_with("nodes.0.scale", [-2, -2, -2]), "gltf"),
    "gltf that flattens": (gltf_with("nodes.0.scale", [0, 0, 0]), "gltf"),
    "gltf with a node of its own": (gltf_with("nodes.0.children", [0]), "gltf"),
    "gltf with a ring of nodes": (nested_gltf(2000), "gltf"),
    "checkpoint that is none": (b"PK\3\4" + bytes(99), "checkpoint"),
    "checkpoint of text": (b"hello", "checkpoint"),
    "checkpoint of an old pickle": (pickle.dumps({"splats": {}}), "checkpoint"),
}  # fmt: skip


@pytest.fixture
def little_memory() -> Iterator[None]:
    """Fail if more than MEMORY is held at any time in the test."""
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MEMORY


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_in_two_lines(name, little_memory):
    data, format = BAD[name]
    with pytest.raises(SplatwizardError) as caught:
        decode(data, format, name="bad.file", limits=LIMITS)
    assert caught.value.exit_status == 2
    assert str(caught.value).startswith("bad.file")
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_within_a_second_of_work(name):
    """Of the processor, all threads together: other programs do not count."""
    data, format = BAD[name]
    before = time.process_time()
    with pytest.raises(SplatwizardError):
        decode(data, format, limits=LIMITS)
    assert time.process_time() - before < 1


@pytest.mark.parametrize("name", ["spz of a million zeros", "spz of SH of zeros", "sog of one colour"])
def test_a_file_that_repeats_itself_is_read_by_who_says_so(name, monkeypatch):
    data, format = BAD[name]
    with pytest.raises(UserInputError, match=r"SPLATWIZARD_MAX_EXPANSION=\d+$") as caught:
        decode(data, format)
    monkeypatch.setenv("SPLATWIZARD_MAX_EXPANSION", str(caught.value).rpartition("=")[2])
    assert decode(data, format).num_gaussians >= 1 << 18


def test_pictures_beside_a_description_count_for_what_it_claims(tmp_path):
    with zipfile.ZipFile(io.BytesIO(one_colour(1024))) as archive:
        archive.extractall(tmp_path)
    with pytest.raises(UserInputError, match=r"claims 1,048,576 Gaussians of 58,720,256 bytes in memory"):
        read(tmp_path)


def test_what_stands_after_the_attributes_of_a_gzip_bomb_is_not_inflated(little_memory):
    assert decode(GZIP_BOMB, "spz", limits=LIMITS).num_gaussians == 1


@pytest.mark.parametrize("name", samples())
def test_a_file_cut_off_anywhere_is_refused(name, sound):
    sample = sound[name]
    data = sample.data
    for at in {0, 1, 3, 4, 8, 15, 16, 20, 31, 32, 100, len(data) // 2, len(data) - 1}:
        if at < len(data) and not (name == "splat" and at % 32 == 0 and at):
            with pytest.raises(UserInputError):
                decode(data[:at], sample.format, limits=LIMITS)


@pytest.mark.parametrize(("name", "count"), [
    *((name, SLOW_TO_OPEN.get(name, FLIPS)) for name in samples()),
    *(pytest.param(name, 2000, marks=pytest.mark.slow) for name in samples()),
])  # fmt: skip
def test_a_mutated_file_is_a_scene_or_a_clear_error(name, count, sound):
    """100,000 of each: benchmarks/interchange_fuzz.py."""
    refused = told = 0
    for data in mutants(sound[name], count, seed=7):
        try:
            scene = decode(data, sound[name].format, limits=LIMITS)
        except SplatwizardError as error:
            refused += "\n" not in str(error)
            told += 1
        else:
            assert np.isfinite(scene.means).all()
            assert np.isfinite(scene.quats).all()
            assert np.isfinite(scene.log_scales).all()
    assert refused == told > 0


def test_limits_hold(sound):
    for name, sample in sound.items():
        with pytest.raises(UserInputError, match="more than"):
            decode(sample.data, sample.format, limits=Limits(max_gaussians=4)), name


class Trap:
    """A pickle that would run a command."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('it ran')",))


def test_a_checkpoint_that_would_run_code_is_not_opened(tmp_path):
    import torch

    torch.save({"splats": {"means": Trap()}}, tmp_path / "trap.pt")
    with pytest.raises(UserInputError, match="more than tensors"):
        read(tmp_path / "trap.pt")


def test_a_view_that_is_larger_than_its_file_is_refused(tmp_path):
    import torch

    wide = torch.zeros(1, 3).expand(1 << 21, 3)
    torch.save({"splats": {"means": wide}}, tmp_path / "wide.pt")
    assert (tmp_path / "wide.pt").stat().st_size < 1 << 20
    with pytest.raises(UserInputError, match="more than the limit"):
        read(tmp_path / "wide.pt", limits=LIMITS)
    with pytest.raises(UserInputError, match="more than are stored"):
        read(tmp_path / "wide.pt")


def test_a_checkpoint_with_a_bytearray_is_not_opened(tmp_path, little_memory):
    import torch

    torch.save({"splats": {"means": torch.zeros(2, 3)}, "more": "M"}, tmp_path / "sound.pt")
    # GLOBAL bytearray, BININT 400,000,000, TUPLE1, REDUCE in place of the text "M".
    bomb = b"c__builtin__\nbytearray\nJ" + struct.pack("<i", 400_000_000) + b"\x85R"
    with zipfile.ZipFile(tmp_path / "sound.pt") as old, zipfile.ZipFile(tmp_path / "bomb.pt", "w") as new:
        for info in old.infolist():
            content = old.read(info)
            if info.filename.endswith("data.pkl"):
                assert content.count(b"X\x01\0\0\0M") == 1
                content = content.replace(b"X\x01\0\0\0M", bomb)
            new.writestr(info.filename, content)
    with pytest.raises(UserInputError, match="a bytearray"):
        read(tmp_path / "bomb.pt")


def test_primitives_of_a_mesh_are_looked_at_once(monkeypatch):
    looked = []
    has_splats = gltf._has_splats
    monkeypatch.setattr(gltf, "_has_splats", lambda each: looked.append(1) or has_splats(each))
    empty = {"attributes": {}}
    document = {
        "scenes": [{"nodes": list(range(50))}],
        "nodes": [{"mesh": 0}] * 50,
        "meshes": [{"primitives": [empty] * 50}],
    }
    with pytest.raises(UserInputError, match="no splats"):
        decode(glb({"asset": {"version": "2.0"}, **document}), "gltf")
    assert len(looked) == 50


def test_an_instance_of_a_mesh_is_read():
    assert decode(shared_gltf(1, 3), "gltf").num_gaussians == 15


def test_images_beside_a_description_are_files_of_a_sound_size(tmp_path):
    meta = tmp_path / "meta.json"
    write(random_scene(5, 1), meta, format="sog-folder")
    image = tmp_path / "quats.webp"
    with image.open("r+b") as file:
        file.truncate(1 << 30)  # sparse
    with pytest.raises(UserInputError, match=r"1,073,741,824 bytes; 8,388,648 are the most"):
        read(meta)
    image.unlink()
    os.mkfifo(image)
    with pytest.raises(UserInputError, match="is no file"):
        read(meta)


def test_a_pipe_is_no_file(tmp_path):
    """Also one without a writer, which another `open` would wait for."""
    pipe = tmp_path / "a.ply"
    os.mkfifo(pipe)
    for reader in (read, load_ply):
        with pytest.raises(SceneError, match=r"a\.ply: cannot be read: it is no file"):
            reader(pipe)
    with pytest.raises(SceneError, match="cannot be read: it is a folder"):
        load_ply(tmp_path)


def test_elements_and_properties_that_stand_twice_are_refused():
    twice = PLY.replace(b"property", b"element vertex 1\nproperty") + b"end_header\n" + bytes(99)
    with pytest.raises(UserInputError, match="bad header line 'element vertex 1'"):
        decode(twice, "ply")


def test_a_scale_of_many_digits_is_no_map(tmp_path, sound):
    write(random_scene(3, 0), tmp_path / "a.ply")
    told = {"transform": np.eye(4)[:3].tolist(), "scale": 10**400}
    (tmp_path / "map.json").write_text(json.dumps(told))
    with pytest.raises(UserInputError, match="no map of nerfstudio"):
        read(tmp_path / "a.ply", undo_dataparser=tmp_path / "map.json")


def test_sog_refuses_to_write_what_it_would_not_read():
    scene = random_scene(5, 0)
    scene.means[0, 0] = 1e36
    with pytest.raises(UserInputError, match=r"coordinates up to 5\.5e"):
        encode(scene, "sog")
    scene.means[0, 0] = -5e34
    assert decode(encode(scene, "sog")[0]).num_gaussians == 5


def test_a_level_that_gzip_does_not_have_is_refused():
    scene = random_scene(5, 0)
    for version in (2, 3):
        with pytest.raises(UserInputError, match=f"'level' is 10; version {version} is gzip, whose levels end at 9: "):
            encode(scene, "spz", level=10, version=version)
    assert decode(encode(scene, "spz", level=10, version=4)[0]).num_gaussians == 5


def test_options_of_many_values_are_told_by_their_ends():
    with pytest.raises(UserInputError, match=r"'palette' is 0; it may be None, or 1 to 65536$"):
        encode(random_scene(5, 1), "sog", palette=0)

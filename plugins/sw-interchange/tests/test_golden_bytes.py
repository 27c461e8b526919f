"""Files of four Gaussians, byte by byte: values from the formulas of each description, one number at a time."""

import io
import json
import math
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from sw_interchange import GaussianScene, decode, encode
from sw_interchange.order import morton_order
from sw_interchange.spz_packing import inflate

SH_C0 = 0.28209479177387814
ROOT = 2**-0.5


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    """The identity, a negative w, a tie of x and y, z as largest component, no and full opacity, colours beyond the
    clamps, a huge and a tiny scale, coordinates at the ends."""
    return GaussianScene(
        means=np.array([[0, 0, 0], [1.5, -2, 0.25], [-2047.9998, 2047.5, 1 / 4096], [0.1, 0.2, -0.3]], np.float32),
        log_scales=np.array([[0, -1, -2], [5.9375, -10, 0.03], [7, -12, -3.14], [-0.5, -0.25, -0.125]], np.float32),
        quats=np.array([[1, 0, 0, 0], [-0.5, 0.5, -0.5, 0.5], [0, ROOT, -ROOT, 0], [0.1, 0.2, 0.3, 0.9273618]],
                       np.float32),
        opacity_logits=np.array([0, -30, 30, 1.25], np.float32),
        sh_dc=np.array([[0, 1, -1], [1.7, -1.7, 0.5], [4, -4, 0.1], [-0.3, 0.3, 0]], np.float32),
        sh_rest=np.array([[[0.5, -0.5, 0]] * 3, [[0.1, 0.2, 0.3], [-0.1, 0, 0.9], [1.5, -1.5, 0.01]],
                          [[0, 0, 0]] * 3, [[-1, 1, 0.0625], [0.03, -0.03, 0.04], [0.7, -0.7, 0.06]]], np.float32),
    )  # fmt: skip


def half_up(x: float) -> int:
    """Rounded half away from zero."""
    return int(math.copysign(math.floor(abs(x) + 0.5), x))


def byte(x: float) -> int:
    return min(255, max(0, half_up(x)))


def alpha(logit: float) -> float:
    return 1 / (1 + math.exp(-logit))


def unit(quat) -> list[float]:
    norm = math.sqrt(sum(float(q) ** 2 for q in quat))
    return [float(q) / norm for q in quat]


def smallest_three(components: list[float]) -> tuple[int, list[float]]:
    largest = max(range(4), key=lambda i: (abs(np.float32(components[i])), -i))
    sign = -1 if components[largest] < 0 else 1
    return largest, [sign * components[i] for i in range(4) if i != largest]


def test_ply(scene):
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    wanted = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
    wanted += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    rows = wanted.encode()
    for i in range(4):
        values = [
            *scene.means[i],
            0,
            0,
            0,
            *scene.sh_dc[i],
            *(scene.sh_rest[i, k, c] for c in range(3) for k in range(3)),
        ]
        rows += struct.pack("<26f", *values, scene.opacity_logits[i], *scene.log_scales[i], *scene.quats[i])
    assert encode(scene, "ply")[0] == rows


def test_splat(scene):
    wanted = b""
    for i in range(4):
        wanted += struct.pack("<3f", *scene.means[i])
        wanted += np.exp(scene.log_scales[i]).astype("<f4").tobytes()
        colours = [min(1.0, max(0.0, 0.5 + SH_C0 * float(c))) for c in scene.sh_dc[i]]
        wanted += bytes([*(round(255 * c) for c in colours), round(255 * alpha(scene.opacity_logits[i]))])
        wanted += bytes(byte(128 * q + 128) for q in unit(scene.quats[i]))
    data, report = encode(scene, "splat", order="given")
    assert data == wanted
    assert data[28:32] == bytes([255, 128, 128, 128])
    assert report.clamped == {"sh_dc": 2}


def spz_words(scene) -> list[int]:
    words = []
    for quat in scene.quats:
        w, x, y, z = unit(quat)
        largest, others = smallest_three([x, -y, -z, w])  # RUB
        word = largest
        for q in others:
            word = word << 10 | (q < 0) << 9 | min(511, math.floor(511 * abs(q) * math.sqrt(2) + 0.5))
        words.append(word)
    return words


def test_spz(scene):
    flip = (1, -1, -1)
    wanted = b"NGSP" + struct.pack("<IIBBBB", 3, 4, 1, 11, 0, 0)
    for mean in scene.means:  # 2048 does not fit 24 bits with 12 fractional ones
        for axis in range(3):
            wanted += half_up(float(mean[axis]) * flip[axis] * 2**11).to_bytes(4, "little", signed=True)[:3]
    wanted += bytes(byte(255 * alpha(x)) for x in scene.opacity_logits)
    wanted += bytes(byte(255 * (0.15 * float(x) + 0.5)) for x in scene.sh_dc.ravel())
    wanted += bytes(byte(16 * (float(x) + 10)) for x in scene.log_scales.ravel())
    wanted += b"".join(struct.pack("<I", word) for word in spz_words(scene))
    signs = (-1, -1, 1)  # of coefficients -y, z, -x
    for rest in scene.sh_rest:
        for k in range(3):
            for value in rest[k]:
                q = half_up(float(np.float32(value)) * signs[k] * 128) + 128
                wanted += bytes([min(255, max(0, (q + 4) // 8 * 8))])
    data, report = encode(scene, "spz", fractional_bits=11)
    assert inflate(data, 1 << 20, "") == wanted
    assert data[:2] == b"\x1f\x8b"
    assert report.clamped == {"sh_dc": 2, "log_scales": 2, "sh_rest": 2}


def test_spz_version_4_is_a_plain_header_a_table_and_the_same_planes(scene):
    import zstandard

    data = encode(scene, "spz", version=4, fractional_bits=11)[0]
    planes = inflate(encode(scene, "spz", fractional_bits=11)[0], 1 << 20, "")[16:]
    assert data[:32] == b"NGSP" + struct.pack("<IIBBBBI", 4, 4, 1, 11, 0, 6, 32) + bytes(12)
    table = struct.unpack("<12Q", data[32:128])
    assert table[1::2] == (36, 4, 12, 12, 16, 36)
    at, found = 128, b""
    for size in table[::2]:
        found += zstandard.decompress(data[at : at + size])
        at += size
    assert (found, at) == (planes, len(data))


QUATS = [[0.1, 0.9, -0.3, 0.3], [0, 0.6, -0.8, 0], [0.3, 0.3, -0.1, -0.9], [-0.9, 0.3, 0.3, 0.1]]
"""Largest are x, y, z and w, the last three of them negative."""


@pytest.mark.parametrize("name", ["spz", "compressed-ply", "sog"])
def test_each_component_may_be_the_largest(scene, name):
    """Codes beside those of the scene above, in which y is largest nowhere."""
    turned = replace(scene, quats=np.array([unit(quat) for quat in QUATS], np.float32))
    order = [0, 1, 2, 3] if name == "spz" else morton_order(scene.means)
    data = encode(turned, name, **({"fractional_bits": 11} if name == "spz" else {}))[0]
    if name == "spz":
        assert [word >> 30 for word in spz_words(turned)] == [0, 1, 2, 3]
        at = 16 + 4 * (9 + 1 + 3 + 3)
        assert inflate(data, 1 << 20, "")[at : at + 16] == struct.pack("<4I", *spz_words(turned))
        return
    wanted = [smallest_three(unit(turned.quats[i])) for i in order]
    assert sorted(largest for largest, _ in wanted) == [0, 1, 2, 3]
    if name == "sog":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            image = Image.open(io.BytesIO(archive.read("quats.webp"))).convert("RGBA")
        texels = np.asarray(image).reshape(-1, 4)[:4].tolist()
        assert texels == [
            [*(round(255 * (q * math.sqrt(2) * 0.5 + 0.5)) for q in others), 252 + largest]
            for largest, others in wanted
        ]
        return
    rows = np.frombuffer(data.partition(b"end_header\n")[2], "<u4", offset=72, count=16).reshape(4, 4)
    for word, (largest, others) in zip(rows[:, 1].tolist(), wanted, strict=True):
        a, b, c = (unorm(q * ROOT + 0.5, 0, 1, 10) for q in others)
        assert word == largest << 30 | a << 20 | b << 10 | c


def unorm(value: float, low: float, high: float, bits: int) -> int:
    most = 2**bits - 1
    share = 0 if high - low < 1e-5 else min(1, max(0, (value - low) / (high - low)))
    return min(most, max(0, math.floor(share * most + 0.5)))


def test_compressed_ply(scene):
    order = morton_order(scene.means)
    mean, dc = scene.means[order], 0.5 + np.float32(SH_C0) * scene.sh_dc[order]
    scale = np.clip(scene.log_scales[order], -20, 20)
    data = encode(scene, "compressed-ply")[0]
    head, _, rows = data.partition(b"end_header\n")
    assert b"element chunk 1\n" in head
    assert b"element vertex 4\nproperty uint packed_position\nproperty uint packed_rotation\n" in head
    assert b"element sh 4\nproperty uchar f_rest_0\n" in head
    bounds = [each for x in (mean, scale, dc) for each in (*x.min(0), *x.max(0))]
    wanted = struct.pack("<18f", *bounds)
    for i in range(4):
        fields = []
        for x in (mean, scale):
            parts = [unorm(float(x[i, a]), float(x[:, a].min()), float(x[:, a].max()), b) for a, b in
                     ((0, 11), (1, 10), (2, 11))]  # fmt: skip
            fields.append(parts[0] << 21 | parts[1] << 11 | parts[2])
        largest, others = smallest_three(unit(scene.quats[order[i]]))
        rotation = largest
        for q in others:
            rotation = rotation << 10 | unorm(q * ROOT + 0.5, 0, 1, 10)
        colour = 0
        for c in range(3):
            colour = colour << 8 | unorm(float(dc[i, c]), float(dc[:, c].min()), float(dc[:, c].max()), 8)
        colour = colour << 8 | unorm(alpha(scene.opacity_logits[order[i]]), 0, 1, 8)
        wanted += struct.pack("<4I", fields[0], rotation, fields[1], colour)
    for rest in scene.sh_rest[order]:
        wanted += bytes(min(255, max(0, math.trunc(256 * (float(rest[k, c]) / 8 + 0.5)))) for c in range(3)
                        for k in range(3))  # fmt: skip
    assert rows == wanted


def test_sog(scene):
    order = morton_order(scene.means)
    with zipfile.ZipFile(io.BytesIO(encode(scene, "sog", palette=4)[0])) as archive:
        meta = json.loads(archive.read("meta.json"))
        files = {n: archive.read(n) for n in archive.namelist() if n.endswith(".webp")}
    assert all(data[12:16] in (b"VP8L", b"VP8X") for data in files.values())
    pixels = {name: np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")) for name, data in files.items()}
    assert (meta["version"], meta["count"]) == (2, 4)
    assert pixels["means_l.webp"].shape == (4, 4, 4)
    y = np.sign(scene.means) * np.log1p(np.abs(scene.means.astype(np.float64)))
    assert np.allclose(meta["means"]["mins"], y.min(0))
    assert np.allclose(meta["means"]["maxs"], y.max(0))
    texels = {name: image.reshape(-1, 4) for name, image in pixels.items()}
    assert texels["means_l.webp"][0, 3] == 255
    for texel, i in enumerate(order):
        for axis in range(3):
            low, high = y[:, axis].min(), y[:, axis].max()
            step = round((y[i, axis] - low) / (high - low) * 65535)
            found = int(texels["means_l.webp"][texel, axis]) + 256 * int(texels["means_u.webp"][texel, axis])
            assert found == step
            code = texels["scales.webp"][texel, axis]
            assert meta["scales"]["codebook"][code] == pytest.approx(scene.log_scales[i, axis], abs=0.05)
            code = texels["sh0.webp"][texel, axis]
            assert meta["sh0"]["codebook"][code] == pytest.approx(scene.sh_dc[i, axis], abs=0.02)
        largest, others = smallest_three(unit(scene.quats[i]))
        codes = [round(255 * (q * math.sqrt(2) * 0.5 + 0.5)) for q in others]
        assert texels["quats.webp"][texel].tolist() == [*codes, 252 + largest]
        assert texels["sh0.webp"][texel, 3] == max(1, round(255 * alpha(scene.opacity_logits[i])))
        label = int(texels["shN_labels.webp"][texel, 0]) + 256 * int(texels["shN_labels.webp"][texel, 1])
        centroid = pixels["shN_centroids.webp"][label // 64, (label % 64) * 3 : (label % 64) * 3 + 3, :3]
        values = np.array(meta["shN"]["codebook"])[centroid]
        assert np.allclose(values, scene.sh_rest[i], atol=0.02)
    assert pixels["shN_centroids.webp"].shape == (1, 192, 4)


def test_gltf(scene):
    data = encode(scene, "gltf")[0]
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind, size % 4) == (b"glTF", 2, len(data), b"JSON", 0)
    told, blob = json.loads(data[20 : 20 + size]), data[28 + size :]
    assert data[20 + size : 28 + size] == struct.pack("<I4s", len(blob), b"BIN\0")
    primitive = told["meshes"][0]["primitives"][0]
    assert (told["extensionsUsed"], primitive["mode"]) == (["KHR_gaussian_splatting"], 0)
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"

    def column(name: str) -> np.ndarray:
        accessor = told["accessors"][primitive["attributes"][name]]
        view = told["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        assert view["byteOffset"] % 4 == 0
        return np.frombuffer(blob[view["byteOffset"] :][: view["byteLength"]], kind).reshape(4, -1)

    prefix = "KHR_gaussian_splatting:"
    assert np.array_equal(column("POSITION"), scene.means * np.float32([-1, -1, 1]))
    accessor = told["accessors"][primitive["attributes"]["POSITION"]]
    assert accessor["max"] == column("POSITION").max(0).tolist()
    w, x, y, z = scene.quats.T
    assert np.allclose(column(prefix + "ROTATION"), np.stack([-x, -y, z, w], 1), atol=1e-6)
    assert np.allclose(column(prefix + "SCALE"), np.exp(scene.log_scales))
    assert np.allclose(column(prefix + "OPACITY")[:, 0], [alpha(a) for a in scene.opacity_logits])
    assert np.array_equal(column(prefix + "SH_DEGREE_0_COEF_0"), scene.sh_dc)
    for k, sign in enumerate((-1, 1, -1)):
        assert np.array_equal(column(f"{prefix}SH_DEGREE_1_COEF_{k}"), sign * scene.sh_rest[:, k])
    assert column("COLOR_0")[0].tolist() == [
        55,
        146,
        10,
        128,
    ]  # 0.5, 0.782 and 0.218 of sRGB, as light: 0.214, 0.574, 0.039


def test_numbers_of_the_description_are_decoded():
    """One .spz of version 1 and one of version 2, which are not written here."""
    half = np.array([1.5, -2, 0.25], "<f2").tobytes()
    tail = bytes([128, 140, 128, 128, 160, 159, 144, 255, 128, 128])
    old = decode(b"NGSP" + struct.pack("<IIBBBB", 1, 1, 0, 12, 0, 0) + half + tail, spz_frame="raw")
    assert old.means[0].tolist() == [1.5, -2, 0.25]
    assert old.log_scales[0].tolist() == [0, -1 / 16, -1]
    assert np.allclose(old.quats[0], [0, 1, 1 / 255, 1 / 255], atol=1e-4)
    assert old.sh_dc[0, 0] == pytest.approx((140 / 255 - 0.5) / 0.15)
    assert old.opacity_logits[0] == pytest.approx(math.log(128 / 127))
    fixed = b"".join(n.to_bytes(3, "little", signed=True) for n in (4096, -8192, -1))
    second = decode(b"NGSP" + struct.pack("<IIBBBB", 2, 1, 0, 12, 1, 0) + fixed + tail, spz_frame="raw")
    assert second.means[0].tolist() == [1, -2, -1 / 4096]
    assert second.antialiased

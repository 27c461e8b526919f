"""Chapter 6: The files of each method, those of Gaussians."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from bitstream_page.container import array
from bitstream_page.entropy_models import categorical, columns
from bitstream_page.fields import Bytes, check
from bitstream_page.positions import byte_planes, deflate, float_delta, importance_vq, octree, residual_vq

SECTIONS = ("positions", "color", "opacity", "scales", "quats", "sh1", "sh2", "sh3")


def scales_of(static: dict[str, Any]) -> int:
    check(static.get("primitive", "surfel") == "surfel", "primitive")
    return 2 if "primitive" in static else 3


def exact_mode(static: dict[str, Any], sections: dict[str, bytes]) -> dict[str, np.ndarray]:
    return {name: array(section) for name, section in sections.items()}


def quantized(static: dict[str, Any], sections: dict[str, bytes]) -> dict[str, np.ndarray]:
    if "packets" not in static:
        return quantized_rows(static, sections)
    check(sum(n for n, _ in static["packets"]) == static["num_gaussians"], "rows of the packets")
    found: list[dict[str, np.ndarray]] = []
    swell = 0.0
    for number, (n, g) in enumerate(static["packets"], 1):
        part = {name.partition("/")[2]: data for name, data in sections.items() if name.startswith(f"{number}/")}
        part |= {name: data for name, data in sections.items() if part and name == "basis"}
        if part:
            found.append(quantized_rows({**static, "num_gaussians": n}, part))
            swell = g
    joined = {name: np.concatenate([part[name] for part in found]) for name in found[0]}
    return {**joined, "log_scales": joined["log_scales"] + np.float32(swell)}


def tiles(static: dict[str, Any], sections: dict[str, bytes]) -> dict[str, np.ndarray]:
    groups, base = static["groups"], static["base"]
    check(static["first"] + sum(n for _, n, _ in groups) == static["num_gaussians"], "rows of the groups")
    packets = max(int(name.partition("/")[0]) for name in sections) if sections else 0
    finer = {source: packet for packet, source in static.get("finer", []) if packet <= packets}
    numbers = [packet for packet in range(2, packets + 1) if packet not in finer.values()]
    last = {tile: number for number, (tile, _, _) in zip(numbers, groups, strict=False)}
    shown_base = [tile not in last for tile, n in enumerate(base) for _ in range(n)]
    runs = [("1/", static["first"], [True] * static["first"]), ("1/stand-ins/", sum(base), shown_base)]
    for number, (tile, n, m) in zip(numbers, groups, strict=False):
        runs += [(f"{number}/", n, [True] * n), (f"{number}/stand-ins/", m, [last[tile] == number] * m)]
    width = 10 + 3 * ((static["active_sh_degree"] + 1) ** 2 - 1)
    parts: list[dict[str, np.ndarray]] = []
    for prefix, n, shown in runs:
        if n:
            part = {name: sections[prefix + name] for name in SECTIONS if prefix + name in sections}
            packet = finer.get(int(prefix[:-1])) if prefix[:-1].isdigit() else None
            lacks = None if packet is None else np.array(columns(sections[f"{packet}/finer"], n, 3 + width), np.int64)
            rows = quantized_rows({**static, "num_gaussians": n}, part, lacks)
            parts.append({name: values[np.array(shown)] for name, values in rows.items()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def quantized_rows(
    static: dict[str, Any], sections: dict[str, bytes], lacks: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    n, active = static["num_gaussians"], static["active_sh_degree"]
    points = octree(sections["positions"])
    check(len(points) == n, "number of points")
    scales, classes, k, factor = scales_of(static), static["sh_classes"], [0] * n, np.ones(n)
    by_class = static.get("precision", False)
    if by_class:
        k = columns(sections["precision"], n, 1)[0]
        check(all(-4 <= value <= 4 for value in k), "a class of precision")
        factor = np.array([2.0 ** -(value // 2) * (0.7071067811865476 if value % 2 else 1.0) for value in k])
    base = {name: np.array(band_columns(sections[name], n, width, classes, k) if by_class else
                           columns(sections[name], n, width), np.float64).reshape(width, n)
            for name, width in (("color", 3), ("opacity", 1), ("scales", scales), ("quats", 3))}  # fmt: skip
    integers: list[list[int]] = []
    for band in range(1, active + 1):
        activity = [sum(map(abs, row)) for row in zip(*integers, strict=True)] if band > 1 else k
        number = 1 if band == 1 and not by_class else classes
        integers += band_columns(sections[f"sh{band}"], n, 3 * (2 * band + 1), number, activity)
    times, raw = static.get("times", 1), static.get("raw", 0)
    points = (points << raw) + (lacks[:3].T if lacks is not None else (1 << raw) // 2)
    at = 3
    for name, values in base.items():
        base[name] = values * times + (0 if lacks is None else lacks[at : at + len(values)])
        at += len(values)
    for j, column in enumerate(integers):
        integers[j] = [
            times * value + (0 if lacks is None else int(lacks[at + j, i])) for i, value in enumerate(column)
        ]
    rest = np.zeros((n, (static["max_sh_degree"] + 1) ** 2 - 1, 3), np.float32)
    if static.get("sh_basis", False):
        width = len(integers)
        check(len(sections["basis"]) == width * width, "bytes of the basis")
        basis = np.frombuffer(sections["basis"], "i1").reshape(width, width).astype(np.int64)
        sums = (np.array(integers, np.int64).T @ basis).astype(np.float64)
        step = static["rest_step"] / 127
        rest[:, : width // 3] = (sums * (step * factor)[:, None]).reshape(n, -1, 3)
    else:
        colors = np.array(integers, np.float64).reshape(len(integers) // 3, 3, n) * (static["rest_step"] * factor)
        for number, (y, u, v) in enumerate(colors):
            rest[:, number] = rgb(y, u, v)
    x, y, z = base["quats"] * np.minimum(static["quat_step"] * factor, max(static["quat_step"], 0.5))
    norm = x * x + y * y + z * z
    w, long = np.sqrt(np.maximum(1 - norm, 0)), np.sqrt(np.maximum(norm, 1))
    return {
        "means": np.stack([coordinates(points[:, a], static, a) for a in range(3)], 1),
        "sh_dc": rgb(*(base["color"] * (static["dc_step"] * factor)))[:, None],
        "sh_rest": rest,
        "opacity_logits": (base["opacity"][0] * (static["opacity_step"] * factor)).astype(np.float32),
        "log_scales": (base["scales"] * (static["scale_step"] * factor)).T.astype(np.float32),
        "quats": np.stack([w / long, x / long, y / long, z / long], 1).astype(np.float32),
    }


def coordinates(q: np.ndarray, static: dict[str, Any], axis: int) -> np.ndarray:
    top = float(static["top"][axis])
    v = (q + 0.5) * (2 * top * 2.0 ** -static["position_bits"]) - top
    a = np.abs(v)
    floor = np.floor(a)
    u = np.where(a < 1, a, (1 + (a - floor)) * 2.0 ** (floor - 1))
    u = np.where(v < 0, -u, u)
    return (u * static["width"][axis] + static["center"][axis]).astype(np.float32)


def rgb(y: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    a, b, c, d = 1 / np.sqrt(3.0), 1 / np.sqrt(2.0), 1 / np.sqrt(6.0), -2 / np.sqrt(6.0)
    return np.stack([a * y + b * u + c * v, a * y + 0 * u + d * v, a * y - b * u + c * v], 1).astype(np.float32)


def band_columns(section: bytes, n: int, width: int, classes: int, activity: list[int]) -> list[list[int]]:
    """Columns in classes, rows of all in place."""
    file = Bytes(section)
    lengths = file.unpack("I" * classes)
    limits = [sorted(activity)[n * i // classes] for i in range(1, classes)] if n else []
    class_of = [bisect.bisect_right(limits, value) for value in activity]
    found = [[0] * n for _ in range(width)]
    for number, length in enumerate(lengths):
        rows = [i for i in range(n) if class_of[i] == number]
        content = file.take(length)
        check(bool(rows) == bool(content), "a class and its rows")
        for column, values in zip(found, columns(content, len(rows), width) if rows else [], strict=False):
            for i, value in zip(rows, values, strict=True):
                column[i] = value
    file.done()
    return found


def ply(static: dict[str, Any], section: bytes) -> dict[str, np.ndarray]:
    n, r, scales = static["num_gaussians"], (static["max_sh_degree"] + 1) ** 2 - 1, scales_of(static)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(3 * r)),
             "opacity", *(f"scale_{i}" for i in range(scales)), "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    lines += [f"property float {name}" for name in names] + ["end_header"]
    file = Bytes(section)
    for line in lines:
        check(file.take(len(line) + 1) == f"{line}\n".encode("ascii"), "header of the .ply")
    table = np.frombuffer(file.rest(), "<f4").reshape(n, len(names))
    return {
        "means": table[:, :3],
        "sh_dc": table[:, None, 6:9],
        "sh_rest": table[:, 9 : 9 + 3 * r].reshape(n, 3, r).transpose(0, 2, 1),
        "opacity_logits": table[:, 9 + 3 * r],
        "log_scales": table[:, 10 + 3 * r : 10 + scales + 3 * r],
        "quats": table[:, 10 + scales + 3 * r :],
    }


def packed(
    static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> dict[str, np.ndarray]:
    n, r, scales = static["num_gaussians"], (static["max_sh_degree"] + 1) ** 2 - 1, scales_of(static)
    tails = {"sh_dc": (1, 3), "sh_rest": (r, 3), "opacity_logits": (), "log_scales": (scales,), "quats": (4,)}
    planes = {name: byte_planes(sections[name], "f4", (n, *tail), unzstd) for name, tail in tails.items()}
    return {"means": float_delta(sections["means"], (n, 3), unzstd), **planes}


def vectree(
    static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> dict[str, np.ndarray]:
    n, bands = static["num_gaussians"], (static["max_sh_degree"] + 1) ** 2
    parts = [sections[name] for name in ("vq", "mask", "index", "codebook", "sh_keep")]
    colors = importance_vq(*parts, n, 3 * bands, unzstd).astype("<f4")
    attributes = byte_planes(sections["attr"], "f2", (n, 8), unzstd).astype("<f4")
    return {
        "means": float_delta(sections["xyz"], (n, 3), unzstd),
        "sh_dc": colors[:, None, :3],
        "sh_rest": colors[:, 3:].reshape(n, 3, bands - 1).transpose(0, 2, 1),
        "opacity_logits": attributes[:, 0],
        "log_scales": attributes[:, 1:4],
        "quats": attributes[:, 4:],
    }


def indexed(
    static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> dict[str, np.ndarray]:
    n, colors, shapes = static["num_gaussians"], static["num_colors"], static["num_shapes"]
    bands = (static["max_sh_degree"] + 1) ** 2
    check(static["arrays"] in ("deflate", "byte-planes"), "coder of the arrays")

    def read(name: str, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
        if static["arrays"] == "deflate":
            return deflate(sections[name], dtype, shape)
        return byte_planes(sections[name], dtype, shape, unzstd)

    for name, size in (("color_index", colors), ("shape_index", shapes)):
        index = read(name, "u2" if size <= 2**16 else "u4", (n,))
        check(set(index.tolist()) == set(range(size)), "every entry is used")
    steps, zeros = array(sections["steps"]), array(sections["zeros"])
    sizes = {"opacity": (n,), "factor": (n,), "dc": (colors, 1, 3), "rest": (colors, bands - 1, 3),
             "shape": (shapes, 3), "quat": (shapes, 4)}  # fmt: skip
    found = [
        (read(name, "u1", size).astype(np.int32) - zeros[at]).astype("<f4") * steps[at]
        for at, (name, size) in enumerate(sizes.items())
    ]
    names = ("opacity_values", "log_factors", "color_dc", "color_rest", "shape_scales", "shape_quats")
    values = dict(zip(names, found, strict=True))
    values["opacity_values"] = values["opacity_values"].clip(0, 1)
    return {"means": read("xyz", "f2", (n, 3)).astype("<f4"), **values}


def chimera(
    static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> dict[str, np.ndarray]:
    check(static["max_sh_degree"] == 3 and static["vq"] == "importance-vq", "coder of the vectors")
    groups = []
    for group, n, rest in (("sh2", static["num_gaussians"] - static["num_sh3"], 8), ("sh3", static["num_sh3"], 15)):
        d = 3 + 3 * rest
        means, attributes, colors = np.zeros((0, 3), "<f4"), np.zeros((0, 8), "<f4"), np.zeros((0, d), "<f4")
        if n:
            means = chimera_means(static["xyz"], group, n, sections, unzstd)
            attributes = byte_planes(sections[f"{group}/attributes"], "f2", (n, 8), unzstd).astype("<f4")
            parts = [sections[f"{group}/vq/{name}"] for name in ("header", "mask", "indices", "codebook", "own")]
            colors = importance_vq(*parts, n, d, unzstd).astype("<f4")
        higher = np.zeros((n, 15, 3), "<f4")
        higher[:, :rest] = colors[:, 3:].reshape(n, 3, rest).transpose(0, 2, 1)
        groups.append((means, colors[:, None, :3], higher, attributes[:, 0], attributes[:, 1:4], attributes[:, 4:]))
    names = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")
    return {name: np.concatenate(both) for name, *both in zip(names, *groups, strict=True)}


def chimera_means(
    xyz: str, group: str, n: int, sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> np.ndarray:
    section = sections[f"{group}/xyz"]
    if xyz == "float32":
        return float_delta(section, (n, 3), unzstd)
    if xyz == "float16":
        return byte_planes(section, "f2", (n, 3), unzstd).astype("<f4")
    check(xyz == "uniform16", "positions")
    low, high = array(sections[f"{group}/box"])
    return (low + octree(section) / 65535 * (high - low)).astype("<f4")


def compact(
    static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> dict[str, np.ndarray]:
    n, coder, hidden = (static[name] for name in ("num_gaussians", "coder", "hidden"))
    levels, features, growth = (static[name] for name in ("grid_levels", "grid_features", "grid_growth"))
    sizes = []
    for level in range(levels):
        exponent = level / (levels - 1) if levels > 1 else 0
        s = static["grid_coarsest"] * (growth ** (levels - 1)) ** exponent - 1
        vertices = math.ceil(s - 1e-9) + 1
        sizes.append(-(-min(1 << static["grid_log2"], vertices**3) // 8) * 8)
    if static["form"] == "plain":
        means, opacities, table = (array(sections[name]) for name in ("positions", "opacities", "grid"))
    else:
        check(static["form"] == "post-processed", "form")
        means = byte_planes(sections["positions"], "f2", (n, 3), unzstd)
        file = Bytes(sections["opacities"])
        low, step = file.unpack("ff")
        opacities = low + np.array(categorical(file.rest(), 256, 1, [0] * n, coder), np.float64) * step
        file = Bytes(sections["grid"])
        scale, zero = file.unpack("fi")
        level_of = [level for level, size in enumerate(sizes) for _ in range(size * features)]
        symbols = np.array(categorical(file.rest(), 256, levels, level_of, coder))
        table = np.float32(scale) * (symbols - zero).astype(np.float32)
    weights, at = array(sections["network"]).astype("<f4"), 0
    layers = {}
    for i, (a, b) in enumerate(((features * levels + 10, hidden), (hidden, hidden), (hidden, 3))):
        layers[f"color.layers.{i}.weight"] = weights[at : at + a * b].reshape(b, a)
        at += a * b
    check(at == len(weights), "weights of the network")
    scales, quats = (
        residual_vq(*(sections[f"{name}/{part}"] for part in ("header", "codebooks", "indices")), n, d)
        for name, d in (("scales", 3), ("rotations", 4))
    )
    return {
        "means": means.astype("<f4"),
        "opacities": np.clip(opacities.astype("<f4"), 0, 1),
        "scales": np.maximum(scales, np.float32(1e-8)),
        "quats": quats,
        "color.grid.table": table.astype("<f4").reshape(sum(sizes), features),
        **layers,
    }


def raht(static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]) -> dict[str, np.ndarray]:
    n, blocks, degree = static["num_gaussians"], static["blocks"], static["max_sh_degree"]
    points, (low, high) = octree(sections["positions"]), array(sections["box"])
    check(len(points) == n, "number of points")
    offset = 0.5 if static["anchor"] == "center" else 0.0
    means = low + (points + offset) * ((high - low) * 2.0 ** -static["depth"])
    steps = byte_planes(sections["steps"], "f4", (blocks, 10), unzstd)

    def lattice(name: str, rows: int, start: int, stop: int) -> np.ndarray:
        symbols = np.array(columns(sections[name], rows, stop - start), np.float32).reshape(stop - start, rows).T
        sizes = [rows // blocks + (block < rows % blocks) for block in range(blocks)]
        return np.repeat(steps[:, start:stop], sizes, axis=0) * symbols

    first = array(sections["mean"])[None]
    coefficients = np.concatenate([first, lattice("detail", max(n - 1, 0), 0, 7)]).astype(np.float64)[:n]
    raht_inverse(coefficients, [sum(morton_bits(point)) for point in points.tolist()])
    half = coefficients[:, 1:4] / 2
    (cx, cy, cz), (sx, sy, sz) = (part.T for part in cosine_and_sine(half))
    quats = [cz * cy * cx + sz * sy * sx, cz * cy * sx - sz * sy * cx, cz * sy * cx + sz * cy * sx,
             sz * cy * cx - cz * sy * sx]  # fmt: skip
    bands = (degree + 1) ** 2 - 1
    rest = np.zeros((n, 0, 3), np.float32)
    if degree:
        (index,) = columns(sections["index"], n, 1)
        entries = byte_planes(sections["codebook"], "f2", (static["codebook_size"], 3 * bands), unzstd)
        rest = entries.astype(np.float32)[index].reshape(n, bands, 3)
    found = {
        "means": means, "sh_dc": coefficients[:, None, 4:], "sh_rest": rest, "opacity_logits": coefficients[:, 0],
        "log_scales": lattice("scales", n, 7, 10), "quats": np.stack(quats, 1),
    }  # fmt: skip
    return {name: values.astype(np.float32) for name, values in found.items()}


def gsc_quant(static: dict[str, Any], sections: dict[str, bytes]) -> dict[str, np.ndarray]:
    n, degree, bits = static["num_gaussians"], static["sh_degree"], static["bits"]
    points = octree(sections["position"]) if n else np.zeros((0, 3), np.int64)
    rest = np.zeros((n, (degree + 1) ** 2 - 1, 3), np.float32)
    check(len(points) == n, "number of points")

    def values(section: str, attribute: str, width: int) -> np.ndarray:
        codes = np.array(columns(sections[section], n, width) if n else [], np.float64).reshape(width, n).T
        return under_range(codes, static["ranges"][attribute], bits)

    for band in range(1, degree + 1):
        found = values(f"sh{band}", "sh", 3 * (2 * band + 1))
        rest[:, band**2 - 1 : (band + 1) ** 2 - 1] = found.reshape(n, 2 * band + 1, 3)
    return {
        "means": under_range(points, static["ranges"]["position"], static["position_bits"]),
        "sh_dc": values("sh0", "sh", 3)[:, None],
        "sh_rest": rest,
        "opacity_logits": values("opacity", "opacity", 1)[:, 0],
        "log_scales": values("scaling", "scale", 3),
        "quats": values("rotation", "quaternion", 4),
    }


def under_range(codes: np.ndarray, ends: Any, bits: int) -> np.ndarray:
    low, high = np.float64(ends[0]), np.float64(ends[1])
    top = 2**bits - 1
    return np.where(codes == top, high, low + codes * ((high - low) / top)).astype(np.float32)


def morton_bits(point: list[int]) -> list[int]:
    """The bits of a Morton code that are set, as numbers."""
    return [1 << (3 * bit + axis) for axis in range(3) for bit in range(21) if point[axis] >> bit & 1]


def raht_inverse(rows: np.ndarray, codes: list[int]) -> None:
    """Coefficients become values, in place."""
    merges = []
    for i in range(1, len(codes)):
        h = (codes[i - 1] ^ codes[i]).bit_length() - 1
        left = bisect.bisect_left(codes, codes[i] >> (h + 1), key=lambda code, h=h: code >> (h + 1))
        end = bisect.bisect_right(codes, codes[i] >> h, key=lambda code, h=h: code >> h)
        merges.append((h, left, i, end))
    for _, left, i, end in sorted(merges, reverse=True):
        w, v = float(i - left), float(end - i)
        a, b = np.sqrt(w / (w + v)), np.sqrt(v / (w + v))
        low, high = rows[left].copy(), rows[i].copy()
        rows[left], rows[i] = a * low - b * high, b * low + a * high


def cosine_and_sine(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    h, j = 1.5707963267341256, 6.077100506506192e-11
    q = np.rint(x / (h + j))
    r = (x - q * h) - q * j
    t = r * r
    c, s = np.zeros_like(x), np.zeros_like(x)
    for i in range(9, -1, -1):
        c = c * t + (-1) ** i / math.factorial(2 * i)
        s = s * t + (-1) ** i / math.factorial(2 * i + 1)
    s = s * r
    quarter = q.astype(int) % 4
    return np.choose(quarter, [c, -s, -c, s]), np.choose(quarter, [s, c, -s, -c])

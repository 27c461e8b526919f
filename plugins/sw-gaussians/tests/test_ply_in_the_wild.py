"""Headers of .ply files as programs write them, and of those that people take for Gaussians."""

import numpy as np
import pytest
from sw_gaussians.ply_gaussians import parse_gaussians, property_names

from splatwizard_core.api import SH_C0
from splatwizard_core.errors import BitstreamError, SceneError

N = 3
CODES = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4"}


def table(names: list[str], types: dict[str, str] | None = None) -> np.ndarray:
    """Rows whose column i holds i + 1/4, i + 1 + 1/4, ...: each value tells where it stood."""
    row = np.dtype([(name, CODES[(types or {}).get(name, "float")]) for name in names])
    found = np.zeros(N, row)
    for i, name in enumerate(names):
        found[name] = np.arange(N) + i + (0.25 if row[name].kind == "f" else 0)
    return found


def file(rows: np.ndarray, *, extra: str = "", order: str = "<", end: str = "\n", gap: str = " ") -> bytes:
    words = {code: word for word, code in CODES.items()}
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    lines = ["ply", f"format {form} 1.0", *filter(None, extra.split("\n")), f"element vertex {len(rows)}"]
    for name in rows.dtype.names or ():
        lines.append(f"property {words[rows.dtype[name].str[1:]]} {name}")
    head = end.join(line.replace(" ", gap) for line in [*lines, "end_header"]) + end
    if not order:
        return head.encode() + "\n".join(" ".join(f"{x:e}" for x in row.item()) for row in rows).encode()
    return head.encode() + rows.astype(rows.dtype.newbyteorder(order)).tobytes()


FULL = property_names(15)
PLAIN = [name for name in FULL if not name.startswith("n")]  # Postshot since 0.5.225: 59 properties
NO_REST = [name for name in FULL if not name.startswith("f_rest")]
ONE_BAND = [name for name in FULL if not name.startswith("f_rest_") or int(name[7:]) < 9]
POLYCAM = [*FULL[:3], *FULL[-4:], *FULL[-7:-4], *FULL[6:9], "opacity", *FULL[9:54], *FULL[3:6]]
NERFSTUDIO = sorted(PLAIN)
DIALECTS = {
    "Inria": file(table(FULL)),
    "Postshot": file(table(PLAIN), extra="comment antialiased 1"),
    "Postshot, one band": file(table(ONE_BAND), extra="comment antialiased 0"),
    "Polycam": file(table(POLYCAM)),
    "nerfstudio before 2024": file(table(NERFSTUDIO)),
    "WorldGen and MonoGS": file(table(NO_REST)),
    "Geomagic": file(table(FULL), end="\r\n", extra="obj_info a scan\nobj_info and more"),
    "tabs": file(table(FULL), gap="\t", extra="comment several\ncomment comments"),
    "a byte order mark": b"\xef\xbb\xbf" + file(table(FULL)),
    "a mark before text": b"\xef\xbb\xbf" + file(table(FULL), order=""),
    "doubles": file(table(FULL, dict.fromkeys(FULL, "double"))),
    "big endian": file(table(FULL), order=">"),
    "text with exponents": file(table(FULL), order=""),
    "no faces": file(table(FULL)).replace(b"end_header", b"element face 0\nproperty list uchar int i\nend_header"),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_each_value_stands_in_its_column(name):
    data = DIALECTS[name]
    header = data[: data.index(b"end_header")].decode("utf-8-sig").replace("\t", " ").split("element face")[0]
    names = [line.split()[2] for line in header.splitlines() if line.startswith("property")]
    found = parse_gaussians(data, "a.ply")
    for values, columns in (
        (found.means, ["x", "y", "z"]),
        (found.sh_dc, ["f_dc_0", "f_dc_1", "f_dc_2"]),
        (found.opacity_logits[:, None], ["opacity"]),
        (found.log_scales, ["scale_0", "scale_1", "scale_2"]),
        (found.quats, ["rot_0", "rot_1", "rot_2", "rot_3"]),
    ):
        assert np.array_equal(values, np.array([names.index(each) for each in columns]) + np.arange(N)[:, None] + 0.25)
    k = sum(each.startswith("f_rest") for each in names) // 3
    assert found.sh_rest.shape == (N, k, 3)
    for i in range(k):
        for channel in range(3):
            assert found.sh_rest[0, i, channel] == names.index(f"f_rest_{channel * k + i}") + 0.25
    assert found.antialiased == (name == "Postshot")
    assert found.ignored == ()


def test_columns_of_others_are_named_and_colours_do_not_win_over_coefficients():
    more = ["red", "green", "blue", "alpha", "segment", "semantic_0"]
    rows = table([*FULL, *more], {"red": "uchar", "green": "uchar", "blue": "uchar", "alpha": "uchar"})
    found = parse_gaussians(file(rows), "a.ply")
    assert found.ignored == tuple(more)
    assert found.sh_dc[0].tolist() == [6.25, 7.25, 8.25]


def test_bytes_of_colour_and_alpha_stand_for_coefficients_and_opacity():
    names = ["x", "y", "z", "red", "green", "blue", "alpha", *FULL[-7:]]
    rows = table(names, dict.fromkeys(("red", "green", "blue", "alpha"), "uchar"))
    rows["red"], rows["alpha"] = 255, [0, 51, 255]
    found = parse_gaussians(file(rows), "a.ply")
    assert np.allclose(found.sh_dc[:, 0], 0.5 / SH_C0)
    assert np.allclose(1 / (1 + np.exp(-found.opacity_logits)), [0, 0.2, 1], atol=2e-6)
    assert found.ignored == ()


def test_interleaved_coefficients_are_read_where_that_is_said():
    found = parse_gaussians(file(table(FULL)), "a.ply", interleaved=True)
    assert found.sh_rest[0, :2].tolist() == [[9.25, 10.25, 11.25], [12.25, 13.25, 14.25]]


def test_a_double_beyond_float32_becomes_infinite():
    rows = table(FULL, {"x": "double"})
    rows["x"][1] = 1e300
    assert np.isinf(parse_gaussians(file(rows), "a.ply").means).tolist() == [
        [False] * 3,
        [True, False, False],
        [False] * 3,
    ]


def test_text_may_hold_no_numbers():
    rows = table(FULL)
    rows["y"][0] = np.nan
    assert np.isnan(parse_gaussians(file(rows, order=""), "a.ply").means).sum() == 1


POINTS = ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
OTHERS = {
    "input.ply of 3DGS and Luma's points": (POINTS, "a point cloud.*input.ply"),
    "4D Gaussians": ([*FULL, "t"], "move with time"),
    "Gaussians with trajectories": ([*FULL, "motion_0", "motion_1"], "move with time"),
    "a count that is no degree": (FULL[:9] + FULL[9:19] + FULL[-8:], "10 f_rest"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_others_are_refused_by_what_they_are(name):
    names, message = OTHERS[name]
    with pytest.raises(SceneError, match=message):
        parse_gaussians(file(table(names, dict.fromkeys(("red", "green", "blue"), "uchar"))), "a.ply")


def test_rows_of_another_length_are_refused_with_both_numbers():
    data = file(table(FULL))
    with pytest.raises(BitstreamError, match=f"claims {N * 248} bytes of data, the file holds {N * 248 - 12}"):
        parse_gaussians(data[:-12], "a.ply")

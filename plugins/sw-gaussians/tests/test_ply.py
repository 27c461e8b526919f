"""3DGS .ply files: every bit comes back, strangers' files are refused in one line."""

import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement
from sw_gaussians.ply import export_ply, from_ply, load_ply, to_ply
from sw_gaussians.ply_gaussians import file_parts, property_names

from splatwizard_core.errors import BitstreamError, SceneError, SplatwizardError, UserInputError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import SplatModel

DATA = Path(os.environ.get("SPLATWIZARD_TEST_DATA", Path(__file__).parents[4] / "shared" / "data")) / "model"


def random_model(n: int, degree: int, seed: int) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    k = (degree + 1) ** 2
    shapes = [(n, 3), (n, 1, 3), (n, k - 1, 3), (n,), (n, 3), (n, 4)]
    return GaussianModel(*(torch.randn(s, generator=g) * 3 for s in shapes))


def bits(model: GaussianModel) -> dict[str, bytes]:
    return {name: p.detach().numpy().tobytes() for name, p in model.named_parameters()}


@pytest.mark.skipif(not DATA.is_dir(), reason="no trained .ply at hand")
def test_a_trained_file_comes_back_bit_for_bit(tmp_path):
    for source in DATA.glob("*.ply"):
        model = load_ply(source)
        export_ply(model, tmp_path / "copy.ply")
        before, after = source.read_bytes(), (tmp_path / "copy.ply").read_bytes()
        size = 248 * model.num_rows
        assert len(after) - after.index(b"end_header\n") - 11 == size
        assert before[-size:] == after[-size:]
        assert model.active_sh_degree == model.max_sh_degree == 3


@settings(max_examples=25, deadline=None)
@given(n=st.integers(0, 40), degree=st.integers(0, 3), seed=st.integers(0, 2**31))
def test_round_trip_of_any_degree(tmp_path_factory, n, degree, seed):
    path = tmp_path_factory.mktemp("ply") / "model.ply"
    model = random_model(n, degree, seed)
    export_ply(model, path)
    loaded = load_ply(path)
    assert loaded.max_sh_degree == degree
    assert bits(loaded) == bits(model)


def test_rows_that_mean_nothing_are_left_out_and_told(tmp_path, caplog):
    model = random_model(8, 1, 0)
    with torch.no_grad():
        model.opacity_logits[0], model.log_scales[0, 1] = math.inf, -math.inf  # these have a limit
        model.means[1, 2], model.sh_rest[2, 1, 0], model.log_scales[3, 0] = math.nan, math.inf, math.inf
        model.quats[4], model.quats[5, 0], model.opacity_logits[6] = 0.0, math.nan, math.nan
    export_ply(model, tmp_path / "m.ply")
    loaded = load_ply(tmp_path / "m.ply")
    assert loaded.num_rows == 2
    assert torch.equal(loaded.means, model.means[[0, 7]])
    assert loaded.opacities[0] > 0.99999
    assert loaded.log_scales[0, 1] == -20
    assert loaded.origin["left_out"] == {"not_finite": 5, "zero_rotation": 1}
    told = "5 hold values that are no numbers, 1 have a rotation of zero"
    assert f"m.ply: 6 Gaussians mean nothing and were left out: {told}" in caplog.text
    with torch.no_grad():
        model.means[:] = math.nan
    export_ply(model, tmp_path / "m.ply")
    with pytest.raises(SplatwizardError, match=r"m\.ply: all of its 8 Gaussians mean nothing"):
        load_ply(tmp_path / "m.ply")


def test_the_world_of_a_moved_scene_is_kept_and_gone_back_to_in_doubles(tmp_path):
    model = random_model(50, 1, 0)
    model.origin = {"world_origin": [448262.3, 5411932.7, 35.0]}
    export_ply(model, tmp_path / "local.ply")
    assert b"comment world_origin 448262.3 5411932.7 35.0\n" in (tmp_path / "local.ply").read_bytes()
    assert bits(load_ply(tmp_path / "local.ply")) == bits(model)
    model.origin = {**model.origin, "as_world": True}
    export_ply(model, tmp_path / "world.ply")
    from plyfile import PlyData

    vertex = PlyData.read(tmp_path / "world.ply")["vertex"]
    expected = model.means.detach().double() + torch.tensor([448262.3, 5411932.7, 35.0], dtype=torch.float64)
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(vertex[axis], expected[:, i].numpy())
    back = load_ply(tmp_path / "world.ply")
    torch.testing.assert_close(back.means, model.means, atol=1e-6, rtol=0)  # doubles at 5e6 have steps of 1e-9
    assert back.origin["world_origin"] == [448262.3, 5411932.7, 35.0]
    assert torch.equal(back.quats, model.quats)


def test_doubles_far_out_without_a_comment_are_moved_too(tmp_path):
    model = random_model(50, 0, 0)
    parts = file_parts(
        *(getattr(model, name).detach().numpy() for name in ("means",)), model.sh_dc[:, 0].detach().numpy(),
        *(getattr(model, name).detach().numpy() for name in ("sh_rest", "opacity_logits", "log_scales", "quats")),
        add=(4e5, 5e6, 10.0),
    )  # fmt: skip
    (tmp_path / "m.ply").write_bytes(b"".join(parts))
    loaded = load_ply(tmp_path / "m.ply")
    origin = torch.tensor(loaded.origin["world_origin"]).double()
    torch.testing.assert_close(
        loaded.means.double() + origin,
        model.means.double() + torch.tensor([4e5, 5e6, 10.0]).double(),
        atol=1e-5,
        rtol=0,
    )


@pytest.mark.parametrize(
    "comment", ["world_origin 1 2", "world_origin a b c", "world_coordinates nan 0 0", "world_origin"]
)
def test_a_comment_that_says_no_origin_is_none(tmp_path, comment):
    model = random_model(3, 0, 0)
    export_ply(model, tmp_path / "m.ply")
    raw = (tmp_path / "m.ply").read_bytes().replace(b"1.0\n", f"1.0\ncomment {comment}\n".encode(), 1)
    (tmp_path / "m.ply").write_bytes(raw)
    loaded = load_ply(tmp_path / "m.ply")
    assert bits(loaded) == bits(model)
    assert loaded.origin == {}


def test_layout_is_the_one_that_viewers_read(tmp_path):
    model = random_model(2, 3, 0)
    export_ply(model, tmp_path / "m.ply")
    raw = (tmp_path / "m.ply").read_bytes()
    header, _, rows = raw.partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    assert lines[3:] == [f"property float {name}" for name in property_names(15)]
    table = np.frombuffer(rows, "<f4").reshape(2, 62)
    assert not table[:, 3:6].any()  # normals
    # Channel-major: all 15 coefficients of red, then green, then blue.
    assert np.array_equal(table[:, 9:24], model.sh_rest[:, :, 0].detach().numpy())
    assert np.array_equal(table[:, 39:54], model.sh_rest[:, :, 2].detach().numpy())
    assert np.array_equal(table[:, 54], model.opacity_logits.detach().numpy())
    assert np.array_equal(table[:, 58:], model.quats.detach().numpy())


def test_the_bytes_are_those_of_a_public_writer_and_can_be_made_and_read_without_a_file(tmp_path):
    model = random_model(5, 2, 7)
    export_ply(model, tmp_path / "ours.ply")
    table = PlyData.read(tmp_path / "ours.ply")["vertex"].data
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(str(tmp_path / "plyfile.ply"))
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "plyfile.ply").read_bytes() == to_ply(model)
    assert bits(from_ply(to_ply(model), "somewhere")) == bits(model)


def test_ascii_double_and_any_order_are_read(tmp_path):
    model = random_model(4, 1, 3)
    export_ply(model, tmp_path / "m.ply")
    vertex = PlyData.read(tmp_path / "m.ply")["vertex"].data
    names = [*reversed([n for n in vertex.dtype.names if n not in ("nx", "ny", "nz")]), "red"]
    rows = np.zeros(4, dtype=[(n, "u1" if n == "red" else "f8") for n in names])
    for name in names[:-1]:
        rows[name] = vertex[name]
    PlyData([PlyElement.describe(rows, "vertex")], text=True).write(str(tmp_path / "ascii.ply"))
    # plyfile prints doubles with 18 digits, so float32 values survive
    assert bits(load_ply(tmp_path / "ascii.ply")) == bits(model)


def test_big_endian_rows_behind_another_element_are_read(tmp_path):
    model = random_model(4, 1, 3)
    export_ply(model, tmp_path / "m.ply")
    vertex = PlyData.read(tmp_path / "m.ply")["vertex"].data
    other = np.zeros(3, dtype=[("a", "u1"), ("b", "f8")])
    elements = [PlyElement.describe(other, "camera"), PlyElement.describe(vertex, "vertex")]
    PlyData([*elements, PlyElement.describe(other, "more")], byte_order=">").write(str(tmp_path / "big.ply"))
    assert bits(load_ply(tmp_path / "big.ply")) == bits(model)


def test_a_file_is_not_read_row_by_row():
    def calls(n: int) -> int:
        data, count = to_ply(random_model(n, 3, 0)), 0

        def counted(_frame, _event, _argument):
            nonlocal count
            count += 1

        before = sys.getprofile()
        sys.setprofile(counted)
        try:
            from_ply(data, "somewhere")
        finally:
            sys.setprofile(before)
        return count

    assert calls(40) < 1.2 * calls(4)


@pytest.fixture
def good(tmp_path) -> bytes:
    export_ply(random_model(6, 3, 1), tmp_path / "good.ply")
    return (tmp_path / "good.ply").read_bytes()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda raw: raw[:-1], "truncated"),
        (lambda raw: raw[:-400], "truncated"),
        (lambda raw: raw[:40], "has no end"),
        (lambda raw: b"", "does not start with"),
        (lambda raw: b"\x89PNG" + raw, "does not start with"),
        (lambda raw: raw.replace(b"vertex 6", b"vertex 999999999999"), "claims"),
        (lambda raw: raw.replace(b"vertex 6", b"vertex -6"), "bad header line"),
        (lambda raw: raw.replace(b"float opacity", b"list uchar int opacity"), "no place"),
        (lambda raw: raw.replace(b"binary_little_endian", b"binary_middle_endian"), "not a readable"),
        (lambda raw: raw.replace(b"element vertex 6", b"element vertex 1\nelement vertex 5"), "bad"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, good, spoil, message):
    (tmp_path / "bad.ply").write_bytes(spoil(good))
    with pytest.raises(BitstreamError, match=message) as caught:
        load_ply(tmp_path / "bad.ply")
    assert "bad.ply" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda raw: raw.replace(b"float opacity", b"float opaqueness"), "'opacity' is missing"),
        (lambda raw: raw.replace(b"float f_rest_44", b"float f_more_44"), "44 f_rest"),
        (lambda raw: raw.replace(b"element vertex", b"element points"), "no element 'vertex'"),
    ],
)
def test_another_kind_of_ply_is_no_model(tmp_path, good, spoil, message):
    (tmp_path / "other.ply").write_bytes(spoil(good))
    with pytest.raises(SceneError, match=message):
        load_ply(tmp_path / "other.ply")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneError, match="absent"):
        load_ply(tmp_path / "absent.ply")


@settings(max_examples=60, deadline=None)
@given(position=st.integers(0, 500), value=st.integers(0, 255))
def test_a_flipped_header_byte_never_ends_in_another_error(tmp_path_factory, position, value):
    folder = tmp_path_factory.mktemp("flip")
    export_ply(random_model(2, 0, 1), folder / "m.ply")
    raw = bytearray((folder / "m.ply").read_bytes())
    raw[position % len(raw)] = value
    (folder / "m.ply").write_bytes(raw)
    try:
        model = load_ply(folder / "m.ply")
    except UserInputError:
        return
    assert model.num_rows <= 2


def test_export_refuses_models_that_depend_on_the_camera(tmp_path):
    class Anchors(SplatModel):
        pass

    with pytest.raises(SceneError, match="depend on the camera"):
        export_ply(Anchors(), tmp_path / "m.ply")
    export_ply(random_model(2, 2, 0), tmp_path / "m.ply")
    assert [p.name for p in tmp_path.iterdir()] == ["m.ply"]

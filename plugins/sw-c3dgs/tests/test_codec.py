"""The file: what comes back, that a second encoding gives the same bytes, and that damage is told."""

import numpy as np
import pytest
import torch
from sw_gaussians.ply import export_ply, load_ply

from splatwizard_core.api import BitstreamError, ContainerReader, ContainerWriter, GaussianModel, SplatwizardError
from sw_c3dgs.codec import IndexedCodec
from sw_c3dgs.coded import QUANTIZED
from sw_c3dgs.indexed import IndexedGaussians
from sw_c3dgs.method import C3DGS
from sw_c3dgs.model import SharedGaussians
from sw_codecs.positions.ordering import spatial_order
from sw_codecs.testing import check_gaussian_codec

SECTIONS = {"xyz", "color_index", "shape_index", "steps", "zeros", *QUANTIZED}


@pytest.fixture
def hostile():
    """The maker of hostile files, of a package that this one does not need."""
    return pytest.importorskip("sw_kit.hostile_files", reason="sw-kit is not installed")


def sharing(make, n=60, colors=7, shapes=5, degree=3):
    model = SharedGaussians.of(make.cloud(max(n, colors, shapes), degree))
    g = torch.Generator().manual_seed(1)
    tables = {
        "color_index": torch.randint(colors, (n,), generator=g),
        "shape_index": torch.randint(shapes, (n,), generator=g),
        "sh_dc": model.sh_dc[:colors], "sh_rest": model.sh_rest[:colors], "shapes": model.shapes[:shapes],
        "quats": model.quats[:shapes],
    }  # fmt: skip
    model.share(torch.arange(n), **{name: table.detach().clone() for name, table in tables.items()})
    return IndexedGaussians(model.coded())


def written(plugins, model, **settings):
    writer = ContainerWriter("c3dgs", 1)
    writer.static["codec"] = "gaussians-indexed"
    IndexedCodec(plugins, **settings).encode(model, writer)
    return writer.to_bytes()


def read(plugins, data):
    reader = ContainerReader(data, "file.swz")
    model = C3DGS(plugins, None).decode(reader)
    reader.finish()
    return model


@pytest.mark.parametrize("arrays", ["deflate", "byte-planes"])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_what_is_decoded_is_what_was_encoded_in_morton_order(plugins, make, arrays, degree):
    model = sharing(make, degree=degree)
    data = written(plugins, model, arrays=arrays)
    assert set(ContainerReader(data, "file").sections) == SECTIONS
    found = read(plugins, data)
    low, width = model.means.detach().amin(0).double(), model.means.detach().double()
    width = width.amax(0) - low
    cells = ((model.means.detach().double() - low) / width * (2**21 - 1)).long()
    order = spatial_order(cells)
    for name in ("means", "opacities", "log_factors", "sh_dc", "sh_rest", "log_scales", "quats"):
        assert torch.equal(getattr(found, name), getattr(model, name)[order]), name
    assert found.max_sh_degree == degree


def test_entries_are_numbered_by_their_first_use_and_unused_ones_left_out(plugins, make):
    found = read(plugins, written(plugins, sharing(make, n=20, colors=50, shapes=50)))
    for index, entries in ((found.color_index, found.color_dc), (found.shape_index, found.shape_quats)):
        firsts = [int(value) for at, value in enumerate(index) if value not in index[:at]]
        assert firsts == list(range(len(entries)))
        assert len(entries) <= 20


def test_a_second_encoding_gives_the_same_bytes(plugins, make):
    data = written(plugins, sharing(make))
    assert written(plugins, read(plugins, data)) == data


def test_a_fresh_decoder_draws_the_same_picture(plugins, make, rasterizer):
    from splatwizard_core.api import RasterOptions

    model, camera = sharing(make), make.camera([0.0, 0.0, -4.0])
    decoded = read(plugins, written(plugins, model))
    with torch.no_grad():
        images = [
            rasterizer.render(each.gaussians(camera, rasterizer), camera, RasterOptions()).image
            for each in (model, decoded)
        ]
    assert torch.allclose(*images, atol=2e-6)  # the order of the Gaussians is another


@pytest.mark.parametrize("n", [0, 1, 300])
def test_plain_gaussians_keep_a_colour_and_a_shape_each(plugins, make, n):
    model = make.cloud(n)
    decoded = check_gaussian_codec(IndexedCodec, plugins, model)
    assert decoded.counts() == {"num_gaussians": n, "num_colors": n, "num_shapes": n}
    if n == 300:
        order = spatial_order_of(model)
        for name, least in (("sh_dc", 3e-2), ("sh_rest", 5e-3), ("opacities", 3e-3), ("log_scales", 0.6)):
            assert float((getattr(decoded, name) - getattr(model, name)[order]).detach().abs().median()) < least, name


def spatial_order_of(model):
    points = model.means.detach().half().double()
    low = points.amin(0)
    return spatial_order(((points - low) / (points.amax(0) - low) * (2**21 - 1)).long())


def test_many_entries_need_longer_indices(plugins, make):
    """More than 2^16 of them: u32."""
    model = make.cloud(70_000, degree=0)
    found = read(plugins, written(plugins, model, arrays="byte-planes"))
    assert len(found.color_dc) == 70_000
    assert int(found.color_index.max()) == 69_999


def test_sharing_is_what_makes_it_small(plugins, make):
    assert len(written(plugins, sharing(make, n=2000))) < 2000 * 14 < len(written(plugins, make.cloud(2000))) / 2


def test_it_may_be_exported_as_ply(plugins, make, tmp_path):
    model = read(plugins, written(plugins, sharing(make)))
    export_ply(model, tmp_path / "scene.ply")
    found = load_ply(tmp_path / "scene.ply")
    assert isinstance(found, GaussianModel)
    assert torch.equal(found.sh_rest, model.sh_rest)
    assert torch.allclose(found.scales, model.scales.clamp_min(1e-9))


@pytest.mark.parametrize(("name", "value"), [("means", float("nan")), ("sh_dc", float("inf")), ("log_scales", 90.0)])
def test_what_no_reader_would_accept_is_not_written(plugins, make, name, value):
    model = make.cloud(5)
    with torch.no_grad():
        getattr(model, name)[2] = value
    with pytest.raises(SplatwizardError, match="cannot be encoded"):
        written(plugins, model)


@pytest.mark.parametrize(
    ("section", "data", "told"),
    [
        ("steps", np.full(6, 1e38, np.float32), "finite"),
        ("steps", np.zeros(6, np.float32), "above 0"),
        ("steps", np.full(6, np.nan, np.float32), "finite"),
        ("steps", np.ones(6, np.float32), "log factor|negative scale"),
        ("zeros", np.full(6, 2**21, np.int32), "2\\^20"),
        ("zeros", np.array([0, 0, 0, 0, 300, 0], np.int32), "negative scale"),
    ],
)
def test_lattices_that_no_quantizer_has(plugins, make, section, data, told):
    reader = ContainerReader(written(plugins, sharing(make)), "file")
    changed = ContainerWriter("c3dgs", 1, raster=reader.raster)
    changed.static.update(reader.static)
    for name in reader.sections:
        changed.add_array(name, data) if name == section else changed.add(name, reader.section(name))
    with pytest.raises(BitstreamError, match=told):
        read(plugins, changed.to_bytes())


@pytest.mark.parametrize(
    ("key", "value"),
    [("num_gaussians", 2**32 - 1), ("num_colors", 61), ("num_shapes", 0), ("max_sh_degree", 4), ("arrays", "octree")],
)
def test_header_values_that_cannot_be(plugins, make, hostile, key, value):
    parts = hostile.Parts.of(written(plugins, sharing(make)))
    parts.header["static"][key] = value
    with pytest.raises(BitstreamError):
        read(plugins, parts.join())


def test_a_few_entries_for_a_million_gaussians_are_not_gathered_before_the_claim_is_checked(plugins, make, hostile):
    parts = hostile.Parts.of(written(plugins, sharing(make)))
    parts.header["static"]["num_gaussians"] = 2**30
    with pytest.raises(BitstreamError, match="may stand for at most"):
        read(plugins, parts.join())


def test_hostile_files_are_refused_or_decoded_and_nothing_else(plugins, make, hostile):
    seeds = [
        written(plugins, sharing(make)), written(plugins, sharing(make, n=9, degree=1), arrays="byte-planes"),
        written(plugins, make.cloud(0)),
    ]  # fmt: skip
    mutator, tally = hostile.Mutator(3), hostile.Tally()
    for round_ in range(400):
        data, kind = mutator.file(seeds)

        def decode(data=data):
            reader = ContainerReader(data, "file")
            if reader.method != "c3dgs" or not isinstance(reader.static, dict):
                return "another"
            model = C3DGS(plugins, None).decode(reader)
            reader.finish()
            assert all(bool(torch.isfinite(each).all()) for each in model.parameters())
            assert model.sh_rest.shape[0] == model.num_rows
            return "decoded"

        hostile.attempt(decode, f"{round_}, {kind}", 1 << 28, tally, plugins_may_miss=True)
    assert not tally.problems, tally.problems[:3]
    assert tally.outcomes["refused"] > 200
    assert tally.outcomes["decoded"] > 5


def test_a_newer_layout_is_refused(plugins):
    data = ContainerWriter("c3dgs", 2).to_bytes()
    with pytest.raises(BitstreamError, match="c3dgs layout version 2 is unknown"):
        C3DGS(plugins, None).decode(ContainerReader(data, "file.swz"))

"""The files of 3DGS under other methods' names: chosen by name, checked on the way back."""

import math
import tracemalloc

import pytest
import torch
from sw_gaussians.choices import Choosing, CodecChoice
from sw_gaussians.method import GaussianMethod
from sw_gaussians.ply import export_ply
from sw_gaussians.surfels import Surface, SurfelModel

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, ConfigError, UserInputError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins


@pytest.fixture(scope="module")
def plugins():
    return load_plugins()


@pytest.fixture(scope="module")
def model():
    g = torch.Generator().manual_seed(3)
    n = 500
    return GaussianModel(
        torch.randn(n, 3, generator=g), torch.randn(n, 1, 3, generator=g), 0.1 * torch.randn(n, 15, 3, generator=g),
        torch.randn(n, generator=g), torch.randn(n, 3, generator=g) - 3, torch.randn(n, 4, generator=g),
    )  # fmt: skip


QUICK = {"vectree": {"iterations": 5, "batch": 100}, "raht": {"vq_steps": 5}}
"""Settings with which a codec that trains a codebook takes no seconds."""


class SomeMethod(GaussianMethod):
    """Writes with whichever codec it is told."""

    name = "some-method"


class SomeConfig(Choosing):
    codec: CodecChoice


def written(plugins, name, model, **settings):
    writer = ContainerWriter("some-method", 1)
    SomeMethod(plugins, SomeConfig(codec=CodecChoice(name=name, settings=settings))).encode(model, writer)
    return writer


def decoded_from(plugins, reader):
    return SomeMethod(plugins, None).decode(reader)


def test_exact_is_bit_for_bit(plugins, model):
    data = written(plugins, "gaussians-exact", model).to_bytes()
    decoded = decoded_from(plugins, ContainerReader(data, "file.swz"))
    for (name, a), (_, b) in zip(model.named_parameters(), decoded.named_parameters(), strict=True):
        assert torch.equal(a, b), name


def test_settings_reach_the_codec(plugins, model):
    coarse = written(plugins, "gaussians-quantized", model, dc_step=0.2, rest_step=0.2).to_bytes()
    fine = written(plugins, "gaussians-quantized", model).to_bytes()
    assert len(coarse) < 0.8 * len(fine)


def test_an_unknown_codec_is_an_error_that_names_those_there_are(plugins, model):
    with pytest.raises(ConfigError, match="gaussians-exact"):
        written(plugins, "range", model)  # a coder, but not one of Gaussians


@pytest.mark.parametrize("claimed", ["range", "huffman", "x" * 500, 7, None])
def test_a_file_may_name_only_codecs_of_gaussians(plugins, model, claimed):
    writer = written(plugins, "gaussians-exact", model)
    writer.static["codec"] = claimed
    with pytest.raises(BitstreamError, match="codec"):
        decoded_from(plugins, ContainerReader(writer.to_bytes(), "file.swz"))


def rows(model):
    """The Gaussians as raw bytes, whatever their order."""
    parameters = [p.detach()[:, None].flatten(1) for p in model.parameters()]
    return sorted(row.numpy().tobytes() for row in torch.cat(parameters, 1))


def test_ply_is_the_file_that_is_exported(plugins, model, tmp_path):
    export_ply(model, tmp_path / "model.ply")
    reader = ContainerReader(written(plugins, "gaussians-ply", model).to_bytes(), "file.swz")
    assert reader.section("ply") == (tmp_path / "model.ply").read_bytes()
    assert len(reader.section("ply")) == pytest.approx(248 * model.num_rows, abs=1600)
    decoded = decoded_from(plugins, reader)
    for (name, a), (_, b) in zip(model.named_parameters(), decoded.named_parameters(), strict=True):
        assert torch.equal(a, b), name


def test_ply_writes_inactive_bands_as_zeros_and_leaves_the_model_alone(plugins, model):
    partly = GaussianModel(*(p.detach() for p in model.parameters()), active_sh_degree=1)
    before = partly.digest()
    decoded = decoded_from(plugins, ContainerReader(written(plugins, "gaussians-ply", partly).to_bytes(), "f"))
    assert partly.digest() == before
    assert decoded.active_sh_degree == 3
    assert torch.equal(decoded.sh_rest[:, :3], model.sh_rest[:, :3])
    assert not bool(decoded.sh_rest[:, 3:].any())


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_zstd_gives_every_bit_back_in_spatial_order(plugins, model, degree):
    k = (degree + 1) ** 2
    raw = {name: p.detach().clone() for name, p in model.named_parameters()}
    m = GaussianModel(**{**raw, "sh_rest": raw["sh_rest"][:, : k - 1]})
    with torch.no_grad():
        m.means[3, 0], m.means[4, 1], m.means[5, 2] = math.nan, math.inf, -0.0
        m.opacity_logits[7] = -math.inf
    data = written(plugins, "gaussians-zstd", m).to_bytes()
    decoded = decoded_from(plugins, ContainerReader(data, "file.swz"))
    assert rows(decoded) == rows(m)
    assert len(data) < len(written(plugins, "gaussians-exact", m).to_bytes())
    before, after = (each.means.detach().diff(dim=0).nan_to_num(0, 0, 0).abs().mean() for each in (m, decoded))
    assert after < 0.5 * before


@pytest.mark.parametrize("codec", ["gaussians-ply", "gaussians-zstd"])
def test_no_gaussians_and_one(plugins, model, codec):
    for n in (0, 1):
        few = GaussianModel(*(p.detach()[:n] for p in model.parameters()))
        decoded = decoded_from(plugins, ContainerReader(written(plugins, codec, few).to_bytes(), "file.swz"))
        assert rows(decoded) == rows(few)


def rewritten(data, change):
    """The file with other header values or sections, checksums right."""
    old = ContainerReader(data, "file.swz")
    static, sections = dict(old.static), {name: old.section(name) for name in old.sections}
    change(static, sections)
    writer = ContainerWriter("some-method", 1)
    writer.static.update(static)
    for name, content in sections.items():
        writer.add(name, content)
    return ContainerReader(writer.to_bytes(), "file.swz")


@pytest.mark.parametrize("codec", ["gaussians-ply", "gaussians-zstd"])
@pytest.mark.parametrize(
    "change",
    [
        lambda static, sections: static.update(num_gaussians=static["num_gaussians"] - 1),
        lambda static, sections: static.update(num_gaussians=2**32 - 1),
        lambda static, sections: static.update(num_gaussians=-1),
        lambda static, sections: static.update(max_sh_degree=2, active_sh_degree=2),
        lambda static, sections: static.update(max_sh_degree=4),
        lambda static, sections: sections.update({name: data[:-1] for name, data in sections.items()}),
        lambda static, sections: sections.update({name: data + b"\0" for name, data in sections.items()}),
        lambda static, sections: sections.update(dict.fromkeys(sections, b"")),
        lambda static, sections: sections.update({name: b"ply\n" + data for name, data in sections.items()}),
        lambda static, sections: sections.clear(),
    ],
)
def test_a_file_that_contradicts_itself_is_refused_before_memory_is_taken(plugins, model, codec, change):
    reader = rewritten(written(plugins, codec, model).to_bytes(), change)
    tracemalloc.start()
    try:
        with pytest.raises(BitstreamError, match=r"file\.swz"):
            decoded_from(plugins, reader)
        assert tracemalloc.get_traced_memory()[1] < 4 * 236 * model.num_rows + 100_000
    finally:
        tracemalloc.stop()


def test_a_ply_with_another_header_is_refused(plugins, model):
    def swap(static, sections):
        sections["ply"] = sections["ply"].replace(b"property float nx", b"property float x2")

    with pytest.raises(BitstreamError, match=r"section 'ply': is no \.ply of 500 Gaussians"):
        decoded_from(plugins, rewritten(written(plugins, "gaussians-ply", model).to_bytes(), swap))


SURFEL_CODECS = ("gaussians-exact", "gaussians-ply", "gaussians-quantized", "gaussians-zstd")


@pytest.fixture(scope="module")
def surfels(model):
    tensors = [each.detach() for each in model.parameters()]
    found = SurfelModel(*tensors[:4], tensors[4][:, :2].contiguous(), tensors[5])
    found.surface = Surface(1.0, 100.0, 0.05)
    return found


def normals(model):
    w, x, y, z = torch.nn.functional.normalize(model.quats.detach().double(), dim=1).T
    return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)


@pytest.mark.parametrize("name", SURFEL_CODECS)
def test_surfels_come_back_as_surfels(plugins, surfels, name):
    writer = written(plugins, name, surfels)
    assert writer.static["primitive"] == "surfel"
    assert writer.static["depth_ratio"] == 1.0
    decoded = decoded_from(plugins, ContainerReader(writer.to_bytes(), "file.swz"))
    assert type(decoded) is SurfelModel
    assert decoded.surface == surfels.surface
    if name in ("gaussians-exact", "gaussians-ply"):
        for key, parameter in surfels.named_parameters():
            assert torch.equal(getattr(decoded, key), parameter), key
    if name == "gaussians-zstd":
        assert torch.equal(decoded.log_scales.sort(dim=0).values, surfels.log_scales.sort(dim=0).values)


def test_quantised_surfels_keep_their_planes(plugins, surfels):
    with torch.no_grad():
        surfels.opacity_logits.clamp_(min=-4)  # all are drawn: rows can be told apart by their position
    fine = {"position_bits": 21, "quat_step": 1e-4, "scale_step": 1e-4}
    data = written(plugins, "gaussians-quantized", surfels, **fine).to_bytes()
    decoded = decoded_from(plugins, ContainerReader(data, "file.swz"))
    nearest = torch.cdist(surfels.means.double(), decoded.means.double()).argmin(dim=1)
    assert len(nearest.unique()) == decoded.num_rows == surfels.num_rows
    ordered = decoded.log_scales[nearest].detach()
    torch.testing.assert_close(ordered, surfels.log_scales.sort(dim=1, descending=True).values, atol=1e-4, rtol=0)
    cosine = (normals(decoded)[nearest] * normals(surfels)).sum(dim=1).abs()  # either side is the same surfel
    assert torch.rad2deg(torch.acos(cosine.clamp(max=1))).max() < 0.05
    assert len(data) < len(written(plugins, "gaussians-exact", surfels).to_bytes()) / 3


@pytest.mark.parametrize("name", ["gaussians-indexed", "raht", "vectree"])
def test_codecs_that_know_no_surfels_say_so(plugins, surfels, name):
    with pytest.raises(UserInputError, match="three scales each, and these are surfels"):
        written(plugins, name, surfels)


@pytest.mark.parametrize("name", SURFEL_CODECS)
@pytest.mark.parametrize(("key", "value"), [("primitive", None), ("primitive", "blob"), ("depth_ratio", -1)])
def test_a_wrong_primitive_or_surface_is_damage(plugins, surfels, name, key, value):
    writer = written(plugins, name, surfels)
    if value is None:
        del writer.static[key]
    else:
        writer.static[key] = value
    with pytest.raises(BitstreamError):
        decoded_from(plugins, ContainerReader(writer.to_bytes(), "file.swz"))

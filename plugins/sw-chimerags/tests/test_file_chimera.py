"""The file: two groups, everything comes back, and what is damaged says so."""

import json

import numpy as np
import pytest
import torch

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, ConfigError, SplatwizardError
from splatwizard_core.evaluation.evaluate import suggested_rasterizers
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.camera import Camera
from sw_chimerags.file import POSITIONS, ROW_BYTES
from sw_chimerags.method import ChimeraGS
from sw_chimerags.model import LOWER

EXACT = {"codec.sh2.ratio": 0.0, "codec.sh3.ratio": 0.0}


def writer_of(model, **sets) -> ContainerWriter:
    writer = ContainerWriter("chimerags", ChimeraGS.version)
    values = {"codec.settings.iterations": 3, **{key.replace("__", "."): value for key, value in sets.items()}}
    ChimeraGS(load_plugins(), resolve(ChimeraGS, "paper", sets=values).config).encode(model, writer)
    return writer


def decoded(writer: ContainerWriter) -> GaussianModel:
    return ChimeraGS(load_plugins(), None).decode(ContainerReader(writer.to_bytes(), "file.swz"))


def by_place(model) -> torch.Tensor:
    """Rows of the model sorted by their means, which tell them apart."""
    return torch.argsort(model.means[:, 0].detach())


@pytest.mark.parametrize("on", [0, 40, 120])
def test_every_gaussian_comes_back_and_those_off_have_no_degree_3(student, on):
    model = student(on=on)
    before = model.digest()
    found = decoded(writer_of(model, **EXACT))
    assert model.digest() == before
    assert (found.num_rows, found.max_sh_degree, found.active_sh_degree) == (120, 3, 3)
    ours, theirs = by_place(model), by_place(found)
    assert torch.equal(model.means[ours], found.means[theirs])
    for name in ("sh_dc", "opacity_logits", "log_scales", "quats"):
        assert torch.equal(getattr(model, name)[ours].half().float(), getattr(found, name)[theirs]), name
    off = ~model.mask_on()[ours]
    assert int(off.sum()) == 120 - on
    expected = model.sh_rest[ours].detach().half().float()
    expected[off, LOWER:] = 0
    assert torch.equal(found.sh_rest[theirs], expected)
    assert bool((found.sh_rest[: 120 - on, LOWER:] == 0).all())  # degree 2 first


def test_a_group_lies_along_a_curve_through_its_own_box(student):
    found = decoded(writer_of(student(on=60), **EXACT)).means.detach()
    for group in (found[:60], found[60:]):
        steps = (group[1:] - group[:-1]).norm(dim=1).mean()
        shuffled = group[torch.randperm(60, generator=torch.Generator().manual_seed(0))]
        assert steps < 0.7 * (shuffled[1:] - shuffled[:-1]).norm(dim=1).mean()


def test_what_matters_keeps_its_own_colour(student):
    model = student(on=40)
    found = decoded(writer_of(model, codec__sh2__ratio=0.75, codec__sh3__ratio=0.5))
    ours, theirs = by_place(model), by_place(found)
    exact = (found.sh_dc[theirs] == model.sh_dc[ours].half().float()).all(dim=2).squeeze(1)
    on = model.mask_on()[ours]
    for group, share in ((~on, 0.25), (on, 0.5)):
        importance = model.importance[ours][group]
        kept = importance.argsort(descending=True)[: int(share * len(importance))]
        assert bool(exact[group][kept].all())
    assert int(exact.sum()) < 60


@pytest.mark.parametrize("xyz", POSITIONS)
def test_positions_in_each_form(student, xyz):
    model = student()
    writer = writer_of(model, xyz=xyz, **EXACT)
    found = decoded(writer)
    a, b = model.means.detach()[by_place(model)], found.means.detach()[by_place(found)]
    if xyz == "float32":
        assert torch.equal(a, b)
    elif xyz == "float16":
        assert torch.equal(torch.sort(a.half().float()[:, 0]).values, b[:, 0])
    else:
        assert torch.allclose(a, b, atol=1e-4)  # 6 units over 65,535 steps, and neighbours may swap
        assert writer.sections["sh2/xyz"] < writer_of(model, **EXACT).sections["sh2/xyz"]


def test_bytes_are_those_that_the_layout_counts(student):
    """Without what zstd saves: 12 + 16 a Gaussian, its own vector in halves, and a bit of the mask."""
    n, on = 120, 40
    sections = writer_of(student(n, on), **EXACT).sections
    planes = 6  # version, form, CRC-32
    assert sections["sh2/attributes"] <= (n - on) * 16 + planes
    assert sections["sh2/vq/own"] <= (n - on) * 54 + planes
    assert sections["sh3/vq/own"] <= on * 96 + planes
    assert sections["sh3/xyz"] <= on * 12 + planes
    assert sections["sh3/vq/mask"] <= -(-on // 8) + planes


def test_the_picture_does_not_depend_on_the_order_in_the_file(student):
    model = student(on=60)
    rasterizer = NegotiatedRasterizer(load_plugins(), device="cpu", prefer=["reference"])
    eye, up = torch.tensor([0.0, 0, -6]), torch.tensor([0.0, 1, 0])
    camera = Camera.look_at(eye, torch.zeros(3), up, width=24, height=16, fov_x=0.8)
    with torch.no_grad():
        images = [
            rasterizer.render(m.gaussians(camera, rasterizer), camera, RasterOptions()).image
            for m in (model, decoded(writer_of(model, **EXACT)))
        ]
    assert torch.allclose(*images, atol=5e-3)  # halves


def test_the_header_says_who_should_draw_it(student):
    writer = writer_of(student())
    reader = ContainerReader(writer.to_bytes(), "file.swz")
    assert suggested_rasterizers(reader.raster) == ("flash", "tcgs", "speedy", "standard")
    assert reader.raster["sh_degree"] == 3
    assert "prefer" not in writer_of(student(), prefer="[]").raster


def test_equal_models_make_equal_files(student):
    assert writer_of(student()).to_bytes() == writer_of(student()).to_bytes()


def test_the_toolkits_codebook_makes_another_file_of_the_same_layout(student):
    toolkit = writer_of(student(), codec__settings__training="official")
    assert toolkit.to_bytes() != writer_of(student()).to_bytes()
    assert decoded(toolkit).num_rows == 120


def test_importance_of_other_gaussians_is_refused(student):
    model = student()
    with torch.no_grad():
        model.means += 1
    with pytest.raises(SplatwizardError, match="importance"):
        writer_of(model)


def test_what_cannot_be_written_is_told(student):
    model = student()
    with torch.no_grad():
        model.log_scales[3] = torch.nan
    with pytest.raises(SplatwizardError, match="'log_scales' of 1 Gaussians"):
        writer_of(model)
    with pytest.raises(TypeError, match="distilled"):
        writer_of(GaussianModel.from_tensors(*(torch.zeros(0, *s) for s in ((3,), (1, 3), (15, 3), (), (3,), (4,)))))
    with pytest.raises(ConfigError, match="importance-vq"):
        writer_of(student(), codec="range")


def test_no_gaussians_at_all(student):
    model = student(0, 0)
    assert decoded(writer_of(model)).num_rows == 0


HOSTILE = [
    ("num_gaussians", 10**9), ("num_gaussians", -1), ("num_gaussians", 119), ("num_gaussians", 0.5),
    ("num_gaussians", None), ("num_sh3", 2**31), ("num_sh3", 121), ("num_sh3", 39), ("num_sh3", None),
    ("max_sh_degree", 2),
    ("xyz", "float64"), ("xyz", "uniform16"), ("xyz", 3), ("vq", "range"), ("vq", "no-such-coder"), ("vq", None),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value"), HOSTILE)
def test_a_header_that_lies_is_a_bitstream_error(student, key, value):
    writer = writer_of(student())
    writer.static[key] = value
    with pytest.raises(BitstreamError):
        decoded(writer)


@pytest.mark.parametrize("name", ["sh2/xyz", "sh2/attributes", "sh3/vq/header", "sh3/vq/own", "sh2/vq/codebook"])
@pytest.mark.parametrize("damage", ["missing", "empty", "short", "noise"])
def test_a_section_that_is_damaged_is_a_bitstream_error(student, name, damage):
    whole = ContainerReader(writer_of(student()).to_bytes(), "file.swz")
    writer = ContainerWriter("chimerags", 1, raster=whole.raster)
    writer.static = whole.static
    for section in whole.sections:
        data = whole.section(section)
        if section == name:
            if damage == "missing":
                continue
            noise = np.random.default_rng(0).bytes(len(data))
            data = {"empty": b"", "short": data[:-3], "noise": noise}[damage]
        writer.add(section, data)
    with pytest.raises(BitstreamError):
        decoded(writer)


def test_values_that_are_not_finite_are_refused(student):
    whole = ContainerReader(writer_of(student(), xyz="uniform16").to_bytes(), "file.swz")
    planes = load_plugins().coders.load("byte-planes")()
    for name, data in (
        ("sh2/attributes", planes.encode(np.full((80, 8), np.nan, np.float16))),
        ("sh2/box", None),
    ):
        writer = ContainerWriter("chimerags", 1)
        writer.static = whole.static
        for section in whole.sections:
            if section == name and data is None:
                writer.add_array(section, np.array([[0, 0, 0], [1e300, 1, 1]], np.float64))
            else:
                writer.add(section, data if section == name else whole.section(section))
        with pytest.raises(BitstreamError, match="finite"):
            decoded(writer)


def test_a_decoded_gaussian_takes_what_the_cap_counts(student):
    model = decoded(writer_of(student()))
    assert 4 * sum(p[0].numel() for p in model.parameters()) == ROW_BYTES


def test_header_values_are_plain_and_the_version_is_checked(student):
    writer = writer_of(student())
    expected = {"num_gaussians": 120, "num_sh3": 40, "max_sh_degree": 3, "vq": "importance-vq", "xyz": "float32"}
    assert json.loads(json.dumps(writer.static)) == expected
    writer.version = 0
    with pytest.raises(BitstreamError, match="layout version"):
        decoded(writer)


def test_steps_make_the_file_smaller_and_values_multiples_of_them(student):
    model = student(400, 100)
    steps = {"steps__colors": 1 / 32, "steps__opacity": 1 / 8, "steps__scales": 1 / 16, "steps__quats": 1 / 64}
    plain, writer = writer_of(model, **EXACT), writer_of(model, **EXACT, **steps)
    for name in ("sh2/attributes", "sh2/vq/own", "sh3/vq/own"):
        assert writer.sections[name] < 0.8 * plain.sections[name]
    found = decoded(writer)
    ours, theirs = by_place(model), by_place(found)
    for name, step in (("sh_dc", 1 / 32), ("opacity_logits", 1 / 8), ("log_scales", 1 / 16)):
        a, b = getattr(model, name).detach()[ours], getattr(found, name).detach()[theirs]
        assert torch.equal(b, (b / step).round() * step)
        assert float((a - b).abs().max()) <= step / 2 + 1e-3
    unit = torch.nn.functional.normalize(model.quats.detach()[ours], dim=1)
    unit = unit * torch.where(unit[:, :1] < 0, -1.0, 1.0)
    assert float((unit - found.quats.detach()[theirs]).abs().max()) <= 1 / 128 + 1e-6


@pytest.mark.cuda
def test_what_a_gpu_writes_decodes_alike_on_both(student):
    """Codebooks are trained where the model is, so that their bytes may differ; what stands in the file may not."""
    ours, theirs = decoded(writer_of(student().cuda())), decoded(writer_of(student()))
    assert ours.num_rows == theirs.num_rows
    for name in ("means", "opacity_logits", "log_scales", "quats"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    assert writer_of(student().cuda(), **EXACT).to_bytes() == writer_of(student(), **EXACT).to_bytes()

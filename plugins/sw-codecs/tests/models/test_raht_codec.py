"""Codec `raht`: the file holds what was drawn, any model may ask for it, damage is a BitstreamError."""

import copy
import itertools

import numpy as np
import pytest
import torch
from sw_kit.hostile_files import Mutator

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, SplatwizardError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from sw_codecs.models.raht_codec import COLUMNS, Raht
from sw_codecs.models.raht_gaussians import CHANNELS, RahtGaussians, codebook_of, settled_copy
from sw_codecs.models.raht_settings import RahtOptions, RahtSettings
from sw_codecs.positions import morton
from sw_codecs.testing import check_gaussian_codec
from sw_codecs.transforms.euler import quats_of
from sw_codecs.transforms.raht import RahtPlan

QUICK = {"vq_training": "kmeans", "vq_steps": 3, "codebook_size": 32, "blocks": 4, "depth": 10}


@pytest.fixture(scope="module")
def plugins():
    return load_plugins()


def model_of(n=300, degree=3, seed=3, spread=1.0):
    g = torch.Generator().manual_seed(seed)
    bands = (degree + 1) ** 2 - 1
    return GaussianModel(
        spread * torch.randn(n, 3, generator=g), torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, bands, 3, generator=g), torch.randn(n, generator=g), torch.randn(n, 3, generator=g) - 3,
        torch.randn(n, 4, generator=g),
    )  # fmt: skip


def written(plugins, model, **settings):
    writer = ContainerWriter("some-method", 1)
    Raht(plugins, **{**QUICK, **settings}).encode(model, writer)
    return writer


def decoded(plugins, writer):
    return Raht(plugins).decode(ContainerReader(writer.to_bytes(), "file.swz"))


@torch.no_grad()
def drawn(settled):
    """The Gaussians that a settled model draws, as a model; nothing is observed."""
    watched = copy.deepcopy(settled).eval()
    attributes, log_scales, entries = watched.quantised()
    return GaussianModel(
        watched.means, attributes[:, None, 4:], entries[watched.code], attributes[:, 0], log_scales,
        quats_of(attributes[:, 1:4]), active_sh_degree=watched.active_sh_degree,
    )  # fmt: skip


def close(found, drawn, atol=1e-5):
    """Whether two models are equal up to the rounding of float32 sums; a rotation has two quaternions."""
    for name in GaussianModel.RAW:
        a, b = getattr(found, name).detach(), getattr(drawn, name).detach()
        if name == "quats":
            b = b * torch.where((a * b).sum(1, keepdim=True) < 0, -1.0, 1.0)
        assert torch.allclose(a, b, atol=atol), name


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("anchor", ["center", "corner"])
def test_the_file_holds_what_the_settled_model_draws(plugins, degree, anchor):
    settled = settled_copy(model_of(degree=degree), RahtSettings(**QUICK, anchor=anchor), seed=0)
    found = decoded(plugins, written(plugins, settled))
    assert (found.num_rows, found.max_sh_degree) == (settled.num_rows, degree)
    assert torch.equal(found.means, settled.means)
    assert torch.equal(found.log_scales, drawn(settled).log_scales)
    close(found, drawn(settled))


@pytest.mark.parametrize("training", ["kmeans", "batch-mean"])
def test_any_model_may_ask_for_it(plugins, training):
    model = model_of()
    decoded_model = check_gaussian_codec(
        plugins.gaussian_codecs.load("raht"), plugins, model, **{**QUICK, "vq_training": training}
    )
    means, found = model.means.detach(), decoded_model.means.detach()
    cell = float((means.amax(0) - means.amin(0)).max()) / 2**10
    ours, theirs = means[torch.argsort(means[:, 0])], found[torch.argsort(found[:, 0])]
    assert decoded_model.num_rows == 300
    assert float((ours[:, 0] - theirs[:, 0]).abs().max()) <= cell / 2 + 1e-6


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_hardly_any_gaussians(plugins, n):
    model = model_of(n)
    found = decoded(plugins, written(plugins, model))
    assert found.num_rows == n
    order = torch.argsort(model.means[:, 0]), torch.argsort(found.means[:, 0])
    # Blocks of one or two values, whose range is theirs and 0: at most half a step of 1/255 of it.
    assert torch.allclose(model.log_scales[order[0]], found.log_scales[order[1]], atol=0.02)


def test_more_bits_come_nearer(plugins):
    model = model_of(2000)
    errors = []
    for bits in (4, 6, 8, 10):
        settled = settled_copy(model, RahtSettings(**{**QUICK, "bits": bits}), seed=0)
        found = drawn(settled)
        errors.append(float((found.opacity_logits - settled.opacity_logits).detach().square().mean().sqrt()))
    assert all(b < a / 3 for a, b in itertools.pairwise(errors))


def test_the_decoders_plan_is_the_encoders(plugins):
    settled = settled_copy(model_of(), RahtSettings(**QUICK), seed=0)
    reader = ContainerReader(written(plugins, settled).to_bytes(), "f")
    cells = plugins.position_codecs.load("octree")().decode(reader.section("positions"))
    again = RahtPlan(morton.encode(cells)).merges(torch.device("cpu"), torch.float64)
    for a, b in zip(settled.plan().merges(torch.device("cpu"), torch.float64), again, strict=True):
        assert all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("rows", "partners", "a", "b"))


def test_ranges_that_training_has_widened_are_those_of_the_file(plugins):
    settled = settled_copy(model_of(), RahtSettings(**QUICK), seed=0)
    tight = written(plugins, settled)
    with torch.no_grad():
        settled.log_scales *= 3
        settled.quantised()
        settled.log_scales /= 3
    wide = written(plugins, settled)
    close(decoded(plugins, wide), drawn(settled))
    assert decoded(plugins, wide).digest() != decoded(plugins, tight).digest()
    settled.recalibrate()
    close(decoded(plugins, written(plugins, settled)), decoded(plugins, tight))


def test_settling_keeps_the_order_and_the_sum_of_importance():
    model = RahtGaussians.of(model_of(500, spread=0.05), bits=8, blocks=4)
    with torch.no_grad():
        model.means[0] = 10.0
    model.importance.copy_(torch.rand(500))
    total, means = float(model.importance.sum()), model.means.detach().clone()
    optimizer = SplatOptimizer(model, [ParamGroup("codebook", 1e-3), ParamGroup("quats", 1e-3)])
    options = RahtOptions(vq_training="kmeans", vq_steps=2)
    model.settle(optimizer, options, depth=7, size=16, generator=torch.Generator().manual_seed(0))
    assert model.num_rows < 400  # they share voxels
    assert float(model.importance.sum()) == pytest.approx(total, rel=1e-5)
    codes = morton.encode(model.cells.numpy())
    assert (np.diff(codes) > 0).all()
    assert set(codes) == set(morton.encode(model.grid.cells(means.numpy())))
    assert model.codebook.shape == (16, 15, 3)
    assert model.sh_rest.shape == (model.num_rows, 0, 3)
    assert (model.max_sh_degree, model.active_sh_degree) == (3, 3)


def test_every_parameter_that_is_drawn_has_a_gradient():
    model = settled_copy(model_of(), RahtSettings(**QUICK), seed=0)
    drawn = model.gaussians(None, None)
    assert drawn.sh.codebook.shape == (32, 15, 3)
    total = drawn.opacities.sum() + drawn.scales.sum() + drawn.quats.square().sum() + drawn.quats[:, 1].sum()
    (total + drawn.sh.to_dense().square().sum()).backward()
    for name in ("sh_dc", "opacity_logits", "log_scales", "quats", "codebook"):
        grad = getattr(model, name).grad
        assert grad is not None, name
        assert bool(torch.isfinite(grad).all()), name
        assert float(grad.abs().max()) > 0, name
    assert model.means.grad is None


def test_a_checkpoint_brings_a_settled_model_back():
    model = settled_copy(model_of(), RahtSettings(**QUICK), seed=0)
    other = RahtGaussians.of(model_of(), bits=8, blocks=4)
    other.load_resized(copy.deepcopy(model.state_dict()))
    other.load_state_dict_extra(model.state_dict_extra())
    assert other.digest() == model.digest()
    assert drawn(other).digest() == drawn(model).digest()


def test_a_code_book_of_rows_gives_them_back_and_weights_decide():
    rows = torch.eye(5)[torch.randint(5, (200,), generator=torch.Generator().manual_seed(0))]
    options = RahtOptions(vq_training="kmeans", vq_steps=5)
    entries, code = codebook_of(rows, torch.ones(200), options, size=8, generator=torch.Generator().manual_seed(0))
    assert torch.equal(entries[code], rows)
    # One entry for 0 (weight 1) and 1 (weight 3).
    rows, weights = torch.tensor([[0.0], [1.0]]).repeat(50, 1), torch.tensor([1.0, 3.0]).repeat(50)
    options = RahtOptions(vq_training="batch-mean", vq_steps=200)
    entries, _ = codebook_of(rows, weights, options, size=1, generator=torch.Generator().manual_seed(0))
    assert float(entries) == pytest.approx(0.75, abs=0.03)


def test_fewer_gaussians_make_a_smaller_file(plugins):
    model = model_of(1500)
    sizes = []
    for kept in (1500, 1200, 900, 600):
        some = GaussianModel(*(getattr(model, name).detach()[:kept] for name in GaussianModel.RAW))
        sizes.append(len(written(plugins, some).to_bytes()))
    assert sizes == sorted(sizes, reverse=True)


def test_what_cannot_be_written_is_told(plugins):
    settled = settled_copy(model_of(), RahtSettings(**QUICK), seed=0)
    with torch.no_grad():
        settled.log_scales[3:5] = torch.inf
    with pytest.raises(SplatwizardError, match="'log_scales' is not finite in 2 rows"):
        written(plugins, settled)


@pytest.mark.parametrize("degree", [0, 2])
def test_gaussians_that_are_not_finite_are_left_out(plugins, degree):
    model = model_of(degree=degree)
    with torch.no_grad():
        model.log_scales[3:5] = torch.inf
        model.means[8] = torch.nan
        model.opacity_logits[9], model.opacity_logits[10] = torch.nan, torch.inf
    assert decoded(plugins, written(plugins, model)).num_rows == 300 - 4


def rebuilt(whole, **sections):
    writer = ContainerWriter("some-method", 1)
    writer.static.update(whole.static)
    for name in whole.sections:
        writer.add(name, sections.get(name, whole.section(name)))
    return writer


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("num_gaussians", 10**9), ("num_gaussians", -1), ("num_gaussians", 299), ("num_gaussians", None),
        ("max_sh_degree", 4), ("max_sh_degree", 2), ("active_sh_degree", 7), ("depth", 22), ("depth", 9), ("bits", 0),
        ("bits", 7), ("blocks", 5), ("blocks", 0), ("anchor", "middle"), ("codebook_size", 31), ("codebook_size", 0),
    ],
)  # fmt: skip
def test_a_header_that_lies_is_a_bitstream_error(plugins, key, value):
    writer = rebuilt(ContainerReader(written(plugins, model_of()).to_bytes(), "f"))
    writer.static[key] = value
    with pytest.raises(BitstreamError):
        decoded(plugins, writer)


def test_lattices_that_leave_float32_and_voxels_that_repeat_are_refused(plugins):
    whole = ContainerReader(written(plugins, model_of()).to_bytes(), "f")
    planes, columns = plugins.array_coders.load("byte-planes")(), plugins.entropy_models.load("columns")()
    octree = plugins.position_codecs.load("octree")()
    for sections in (
        {"steps": planes.encode(np.full((4, COLUMNS), 3e38, np.float32))},
        {"steps": planes.encode(np.zeros((4, COLUMNS), np.float32))},
        {"zeros": columns.encode(np.full((4, COLUMNS), 256), None)},
        {"positions": octree.encode(np.zeros((300, 3), np.int64), 10)},
        {"index": columns.encode(np.full(300, 32), None)},
        {"detail": columns.encode(np.full((299, CHANNELS), 300), None)},
    ):
        with pytest.raises(BitstreamError):
            decoded(plugins, rebuilt(whole, **sections))


def test_hostile_files_raise_nothing_else(plugins):
    """Sections, table and header are changed with their checksums repaired: a model or a BitstreamError comes out."""
    good = [written(plugins, model_of(40, degree)).to_bytes() for degree in (0, 2)]
    mutator, refused = Mutator(1), 0
    for _ in range(250):
        data, _ = mutator.file(good)
        try:
            found = Raht(plugins).decode(ContainerReader(data, "f"))
        except BitstreamError:
            refused += 1
        else:
            assert all(bool(torch.isfinite(p).all()) for p in found.parameters())
    assert refused > 100


def test_decoding_does_not_depend_on_the_number_of_threads(plugins):
    reader = ContainerReader(written(plugins, model_of(4000)).to_bytes(), "f")
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(Raht(plugins).decode(reader).digest())
    finally:
        torch.set_num_threads(threads)
    assert found[0] == found[1]


@pytest.mark.cuda
def test_what_a_gpu_writes_decodes_alike(plugins):
    settled = settled_copy(model_of(3000), RahtSettings(**QUICK), seed=0)
    there = written(plugins, copy.deepcopy(settled).cuda())
    assert there.to_bytes() == written(plugins, settled).to_bytes()
    close(decoded(plugins, there), drawn(copy.deepcopy(settled).cuda()).cpu())

"""Training draws the values that the file holds, and codebooks get the gradients of those who share them."""

import pytest
import torch

from splatwizard_core.api import ParamGroup, RasterOptions, SplatOptimizer
from sw_c3dgs.coded import QUANTIZED
from sw_c3dgs.indexed import IndexedGaussians
from sw_c3dgs.model import SharedGaussians


@pytest.fixture
def shared(make):
    """60 Gaussians that share 7 colours and 5 shapes."""
    model = SharedGaussians.of(make.cloud(80))
    g = torch.Generator().manual_seed(1)
    tables = {
        "color_index": torch.randint(7, (60,), generator=g), "shape_index": torch.randint(5, (60,), generator=g),
        "sh_dc": model.sh_dc[:7], "sh_rest": model.sh_rest[:7], "shapes": model.shapes[:5], "quats": model.quats[:5],
    }  # fmt: skip
    model.share(torch.arange(0, 60), **{name: table.detach().clone() for name, table in tables.items()})
    return model


@pytest.fixture
def draw(make, rasterizer):
    camera = make.camera([0.0, 0.0, -4.0])

    def render(inputs):
        return rasterizer.render(inputs, camera, RasterOptions()).image

    render.inputs = lambda model: model.gaussians(camera, rasterizer)
    return render


def test_the_stored_symbols_stand_for_the_very_values_that_are_rendered(shared, draw):
    drawn = draw.inputs(shared.train())
    indexed = IndexedGaussians(shared.coded())
    with torch.no_grad():
        again = draw.inputs(indexed)
    for name, tensor in drawn.tensors().items():
        assert torch.equal(tensor, again.tensors()[name]), name
    assert torch.equal(draw(drawn), draw(again))


def test_positions_are_rounded_to_half_and_their_gradient_is_not(shared, draw):
    drawn = draw.inputs(shared)
    assert torch.equal(drawn.means, shared.means.detach().half().float())
    (drawn.means * torch.arange(3.0)).sum().backward()
    assert torch.equal(shared.means.grad, torch.arange(3.0).expand(60, 3))


def test_the_quantizers_hold_zero_and_err_by_half_a_step_at_most(shared, draw):
    drawn = draw.inputs(shared.train())
    coded = shared.coded()
    steps = dict(zip(QUANTIZED, coded.steps, strict=True))
    pairs = {
        "opacity": (drawn.opacities, torch.sigmoid(shared.opacity_logits)),
        "dc": (drawn.sh.codebook[:, :1], shared.sh_dc),
        "rest": (drawn.sh.codebook[:, 1:], shared.sh_rest),
        "quat": (drawn.quats, torch.nn.functional.normalize(shared.quats, dim=1)),
        "shape": (drawn.scales, shared.shapes),
        "factor": (drawn.scale_factors.log(), shared.log_factors),
    }
    for name, (found, exact) in pairs.items():
        assert float((found - exact).detach().abs().max()) <= 0.501 * steps[name] + 1e-6, name
    assert all(-zero + 255 >= 0 and zero >= 0 for zero in coded.zeros)  # 0 is a symbol of every lattice


def test_ranges_follow_training_alone(shared, draw):
    draw.inputs(shared.train())
    before = {name: value.clone() for name, value in shared.quantizers.state_dict().items()}
    with torch.no_grad():
        shared.sh_dc.mul_(3)
        draw.inputs(shared)  # a viewer that looks on
    draw.inputs(shared.eval())
    assert all(torch.equal(value, before[name]) for name, value in shared.quantizers.state_dict().items())
    draw.inputs(shared.train())
    low, high = (float(shared.quantizers.state_dict()[f"dc.{end}"]) for end in ("minimum", "maximum"))
    assert high == pytest.approx(0.99 * float(before["dc.maximum"]) + 0.01 * 3 * float(before["dc.maximum"]), rel=1e-5)
    assert low < float(before["dc.minimum"])


def test_codebooks_change_the_ranges_at_once(make, draw):
    model = SharedGaussians.of(make.cloud(30))
    draw.inputs(model.train())
    tables = {name: getattr(model, name).detach()[:2] for name in ("sh_dc", "sh_rest", "shapes", "quats")}
    index = torch.zeros(30, dtype=torch.int64)
    model.share(torch.arange(30), color_index=index, shape_index=index, **tables)
    draw.inputs(model)
    assert float(model.quantizers.state_dict()["dc.maximum"]) == float(model.sh_dc.detach().max())


def test_an_indexed_render_equals_the_gathered_one_with_scattered_gradients(shared, draw):
    shared.eval()  # ranges stay, so that both draw the same numbers
    weights = torch.rand(3, 36, 48, generator=torch.Generator().manual_seed(4))
    inputs = draw.inputs(shared)
    leaves = {"sh": inputs.sh.codebook, "scales": inputs.scales, "quats": inputs.quats, "factors": inputs.scale_factors}
    image = draw(inputs)
    found = torch.autograd.grad((image * weights).sum(), list(leaves.values()))

    gathered = draw.inputs(shared).gathered()
    own = {
        "sh": gathered.sh.dense.detach().requires_grad_(True), "quats": gathered.quats.detach().requires_grad_(True),
        "scales": gathered.scales.detach().requires_grad_(True),
    }  # fmt: skip
    gathered.sh.dense, gathered.quats, gathered.scales = own["sh"], own["quats"], own["scales"]
    plain = draw(gathered)
    assert torch.allclose(image, plain, atol=1e-6)
    sh, quats, scales = torch.autograd.grad((plain * weights).sum(), [own["sh"], own["quats"], own["scales"]])
    factors, rows = inputs.scale_factors.detach(), inputs.scales.detach()[shared.shape_index]
    expected = {
        "sh": torch.zeros_like(leaves["sh"]).index_add(0, shared.color_index, sh),
        "scales": torch.zeros_like(leaves["scales"]).index_add(0, shared.shape_index, scales * factors[:, None]),
        "quats": torch.zeros_like(leaves["quats"]).index_add(0, shared.shape_index, quats),
        "factors": (scales * rows).sum(1),
    }
    for (name, wanted), gradient in zip(expected.items(), found, strict=True):
        assert torch.allclose(gradient, wanted, rtol=1e-4, atol=1e-5 * float(wanted.abs().max())), name


def test_flat_shapes_are_drawn(shared, draw):
    """An 8-bit scale may be exactly 0: a disc, or a needle."""
    with torch.no_grad():
        shared.shapes[0] = torch.tensor([1.0, -0.2, 0.5])
        shared.shapes[1] = torch.tensor([1.0, 0.0, 0.0])
    inputs = draw.inputs(shared.train())
    assert float(inputs.scales[:2].detach().min()) == 0
    image = draw(inputs)
    image.sum().backward()
    assert bool(torch.isfinite(image).all())
    assert all(bool(torch.isfinite(each.grad).all()) for each in shared.parameters() if each.grad is not None)


def test_a_decoded_model_is_one_of_gaussians(shared):
    indexed = IndexedGaussians(shared.coded())
    assert (indexed.sh_dc.shape, indexed.sh_rest.shape) == ((60, 1, 3), (60, 15, 3))
    assert torch.equal(indexed.quats, indexed.shape_quats[indexed.shape_index])
    assert torch.allclose(indexed.log_scales.exp(), indexed.scales.clamp_min(1e-9), rtol=1e-5)
    assert torch.allclose(torch.sigmoid(indexed.opacity_logits), indexed.opacities, atol=2e-6)
    assert indexed.counts() == {"num_gaussians": 60, "num_colors": 7, "num_shapes": 5}
    assert indexed.max_sh_degree == 3


def test_opacities_of_0_and_1_have_finite_logits(shared):
    with torch.no_grad():
        shared.opacity_logits[0], shared.opacity_logits[1] = 200.0, -200.0
    assert bool(torch.isfinite(IndexedGaussians(shared.coded()).opacity_logits).all())


def test_the_state_comes_back_into_a_model_without_codebooks(shared, make, draw):
    draw.inputs(shared.train())
    fresh = SharedGaussians.of(make.cloud(80))
    fresh.load_resized({name: value.clone() for name, value in shared.state_dict().items()})
    fresh.load_state_dict_extra(shared.state_dict_extra())
    assert fresh.is_shared
    assert fresh.digest() == shared.digest()
    assert torch.equal(draw(draw.inputs(fresh.eval())), draw(draw.inputs(shared.eval())))


def test_an_optimizer_made_before_the_codebooks_updates_them(make, draw):
    model = SharedGaussians.of(make.cloud(30))
    names = ("means", "sh_dc", "sh_rest", "opacity_logits", "shapes", "log_factors", "quats")
    optimizer = SplatOptimizer(model, [ParamGroup(name, 1e-2) for name in names])
    tables = {name: getattr(model, name).detach()[:3] for name in ("sh_dc", "sh_rest", "shapes", "quats")}
    model.share(torch.arange(20), color_index=torch.arange(20) % 3, shape_index=torch.arange(20) % 2, **tables)
    before = {name: getattr(model, name).detach().clone() for name in names}
    draw(draw.inputs(model.train())).square().sum().backward()
    optimizer.step()
    assert all(not torch.equal(getattr(model, name), before[name]) for name in names)
    assert optimizer.moments("sh_dc")[0].shape == (3, 1, 3)

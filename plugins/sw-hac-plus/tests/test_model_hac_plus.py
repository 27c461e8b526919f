"""The model has the published sizes, lies on its lattice, counts its bits by the formulas, and lets them prune."""

import pytest
import torch
from hac_plus_models import decoded, encoded, generator, make, published
from sw_anchors.growth import adjust_anchors
from sw_anchors.noisy_values import draws
from sw_anchors.rate_model import AnchorRate
from sw_anchors.testing import check_nothing_is_waited_for
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.errors import ConfigError
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from sw_codecs.entropy.rates import gaussian_mass
from sw_hac.model import HACAnchors
from sw_hac_plus.config import HACPlusConfig
from sw_hac_plus.stage import HACPlusStage
from sw_hac_plus.voxel_lattice import voxel_integers, within_reach

RASTERIZER = ReferenceRasterizer()


def count(networks):
    return sum(p.numel() for network in networks for p in network.parameters())


@pytest.mark.parametrize(("kind", "channel", "all_networks"), [("full", 40_350, 86_635), ("tiny", 6_870, 53_155)])
def test_sizes_are_the_published_ones(kind, channel, all_networks):
    model = published(channel__kind=kind)
    assert model.mlp_grid[2].out_features == 225
    assert count([model.mlp_grid]) == 32_425
    assert count([model.channel]) == channel
    assert count(model.networks().values()) == all_networks
    assert model.grid.entries == 1_766_272


def test_slices_must_make_up_the_features():
    with pytest.raises(ConfigError, match=r"channel\.slices \[10, 10\] must sum to feature_dim 50"):
        published(channel__slices=[10, 10])


@pytest.mark.parametrize("factor", [16, 128, 4])
def test_anchors_grow_on_the_lattice(factor):
    model = make(n=60)
    optimizer = SplatOptimizer(model, [ParamGroup("features", 0.1)])
    for step in range(5):
        model.offset_grad_accum.fill_(41 * 9e-3)
        model.offset_denom.fill_(41)
        adjust_anchors(model, optimizer, step=step, generator=generator(step), init_factor=factor)
    assert model.num_rows > 60
    integers = voxel_integers(model.anchors, model.voxel_size)
    expected = (integers.double() * model.voxel_size).float()
    assert torch.equal(model.positions(), expected)
    torch.testing.assert_close(model.anchors.detach(), expected, atol=1e-6, rtol=0)
    assert len(torch.unique(integers, dim=0)) == model.num_rows


def test_no_anchor_grows_beyond_what_a_file_holds():
    """An offset of a far start point with a large scale: 29,700 units away, where 2^21 voxels of 0.01 are 20,971."""
    model = make(n=40)
    optimizer = SplatOptimizer(model, [ParamGroup("features", 0.1)])
    with torch.no_grad():
        model.log_scales[10, :3] = 5.0
        model.offsets[10, 0] = torch.tensor([200.0, 0, 0])
        model.offsets[10, 1] = torch.tensor([0.1, 0, 0])  # 15 units away
        model.mask_logits.fill_(1.0)
    model.offset_grad_accum.fill_(41 * 9e-3)
    model.offset_denom.fill_(41)
    report = adjust_anchors(model, optimizer, step=1, generator=generator(0))
    assert report.grown > 0
    assert 10 < float(model.anchors.detach().max()) < 1000
    assert decoded(encoded(model)).num_rows == model.num_rows


def test_anchors_on_both_sides_keep_within_the_reach_together():
    most = 2**21 - 1
    anchors = torch.tensor([[0.0, 0, 0], [1, 0, 0]])

    def taken(*x, size=1.0):
        found = within_reach(torch.tensor([[each * size, 0, 0] for each in x]), anchors * size, size)
        return [each for each, held in zip(x, found.tolist(), strict=True) if held]

    assert taken(most, most + 1) == [most]
    assert taken(1 - most, -most, size=0.5) == [1 - most]
    assert taken(-most // 2 + 9, most // 2) == [-most // 2 + 9, most // 2]  # as far as they may be together
    assert taken(most, -5, most // 2, -most // 2 - 9) == [-5, most // 2]
    assert taken(float("nan"), float("inf"), 7) == [7]
    end = torch.tensor([[2.0**30 - 1, 0, 0], [2.0**30, 0, 0]], dtype=torch.float64)
    assert within_reach(end, end[:1] - 100, 1).tolist() == [True, False]


def rate_of(model, sample=1.0):
    """The rate of a training step that sees the first ten anchors."""
    model.train()
    model.sample = sample
    model.noise = generator(3)
    return model.attributes(torch.arange(10)).extras["rate"]


def noise_of_rate(model):
    """[N,C] noise of all anchors that `rate_of` draws, in steps."""
    g, columns = generator(3), sum(model.shape.widths)
    torch.rand(model.num_rows, generator=g)  # the sample
    draws((10, columns), g, torch.device("cpu"))  # noise of what is rendered
    return draws((model.num_rows, columns), g, torch.device("cpu")) - 0.5


def bits_by_hand(model):
    """[N,C] bits of all anchors by the formulas, under the noise that `rate_of` draws."""
    n, f, k = model.num_rows, model.shape.features, model.num_offsets
    out = model.mlp_grid(model.grid(model.codes() / 65535))
    mu_f, s_f, mu_l, s_l, mu_o, s_o, t, logit = out.split([f, f, 6, 6, 3 * k, 3 * k, 3, f], dim=1)
    steps = torch.tensor([1, 0.001, 0.2]) * (1 + torch.tanh(t))
    wide = steps.repeat_interleave(torch.tensor([f, 6, 3 * k]), dim=1)
    values = torch.cat([model.features, model.log_scales.exp(), model.offsets.flatten(1)], dim=1)
    values = values + noise_of_rate(model) * wide
    x, q = values[:, :f], wide[:, :f]
    p = gaussian_mass(values, torch.cat([mu_f, mu_l, mu_o], 1), torch.cat([s_f, s_l, s_o], 1).clamp(min=1e-9), wide)
    if model.channel is not None:
        second = torch.zeros(3, n, f)
        context = torch.cat([mu_f, s_f, logit], dim=1)
        for i, start in enumerate((0, 2, 5)):
            layers = model.channel.networks[f"slice{i}"]
            hidden = layers[0](torch.cat([x[:, :start], context], dim=1))
            found = layers[2](torch.where(hidden < 0, hidden * 41 / 4096, hidden))
            part = slice(start, start + found.shape[1] // 3)
            second[0, :, part], second[1, :, part], second[2, :, part] = found.chunk(3, dim=1)
        share = torch.sigmoid(logit - second[2])
        q2 = gaussian_mass(x, second[0], second[1].clamp(min=1e-9), q)
        p = torch.cat([share * p[:, :f] + (1 - share) * q2, p[:, f:]], dim=1)
    return -torch.log2(p.clamp(min=1e-6))


def test_the_rate_is_that_of_all_anchors_by_the_formulas():
    model = make(n=40)
    rate, bits = rate_of(model), bits_by_hand(model)
    masks = model.masks()
    there = (masks.sum(1) > 0).float()
    factors = torch.cat([there[:, None].expand(-1, 14), (there[:, None] * masks).repeat_interleave(3, 1)], dim=1)
    expected = (bits * factors).sum() / bits.numel()
    torch.testing.assert_close(rate.bits, expected, rtol=1e-4, atol=0)
    assert float(rate.numbers) == bits.numel()
    torch.testing.assert_close(rate.by_group.sum() / bits.numel(), expected.detach(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("anchor_gradient", [True, False])
def test_the_gradient_of_a_mask_is_the_published_one(anchor_gradient):
    """Also of an anchor that is off: what its bits would be pulls at its masks."""
    model = make(n=12, rate_term__anchor_gradient=anchor_gradient)
    k = model.num_offsets
    rate_of(model).bits.backward()
    bits = bits_by_hand(model).detach()
    masks, soft = model.masks().detach(), torch.sigmoid(model.mask_logits.detach())
    there = (masks.sum(1, keepdim=True) > 0).float()
    by_offset = bits[:, 14:].view(-1, k, 3).sum(2)
    whole = bits[:, :14].sum(1, keepdim=True) + (masks * by_offset).sum(1, keepdim=True)
    expected = soft * (1 - soft) / bits.numel() * (there * by_offset + anchor_gradient * whole / k)
    torch.testing.assert_close(model.mask_logits.grad, expected, rtol=1e-3, atol=1e-9)
    assert bool((model.mask_logits.grad[:5] != 0).any()) == anchor_gradient  # anchors 0 to 4 are off


def test_anchors_that_no_view_sees_have_a_rate_too():
    model = make(n=40)
    rate_of(model).bits.backward()
    for name in ("features", "offsets", "log_scales"):
        assert bool((getattr(model, name).grad[20:].flatten(1) != 0).any(dim=1).all()), name
    assert all(float(p.grad.abs().max()) > 0 for p in model.channel.parameters())
    assert all(float(grid.table.grad.abs().max()) > 0 for grid in model.grid.grids)


@pytest.mark.parametrize("floor", [0.0, 0.05])
def test_deviations_below_zero_learn_if_there_is_a_floor(floor):
    """Deviations of the features as the grid predicts them; without channels, which would see the floor too."""
    model = make(n=40, channel__kind="none", rate_term__scale_floor=floor)
    last = model.mlp_grid[2]
    with torch.no_grad():
        last.weight[8:16], last.bias[8:16] = 0, -1.0
    rate_of(model).bits.backward()
    assert bool((last.bias.grad[8:16] < 0).any()) == bool(floor)


@pytest.mark.parametrize("kind", ["full", "tiny", "none"])
@pytest.mark.parametrize("floor", [0.0, 0.05])
@pytest.mark.parametrize("anchor_gradient", [True, False])
def test_one_node_gives_the_rate_and_gradients_of_torch_operations(kind, floor, anchor_gradient, monkeypatch):
    values = {"channel__kind": kind, "rate_term__scale_floor": floor, "rate_term__anchor_gradient": anchor_gradient}
    found = []
    for by_node in (True, False):
        if not by_node:
            monkeypatch.setattr("sw_hac_plus.fast.mixture_bits.fits", lambda *_: False)
        model = make(n=40, **values)
        rate = rate_of(model)
        (100 * rate.bits).backward()
        grads = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
        found.append({"bits": rate.bits.detach(), "by group": rate.by_group, **grads})
    assert found[0].keys() == found[1].keys()
    assert {"features", "mask_logits", "mlp_grid.2.bias"} <= found[0].keys()
    for name, expected in found[1].items():
        small = 1e-4 * float(expected.abs().max())
        torch.testing.assert_close(found[0][name], expected, rtol=1e-4, atol=small, msg=name)


def test_an_empty_sample_costs_nothing():
    assert float(rate_of(make(n=40), sample=0.0).bits.detach()) == 0


def test_without_channels_the_bits_are_those_of_the_grid():
    model = make(n=40, channel__kind="none")
    assert model.mlp_grid[2].out_features == sum(model.shape.outputs)
    torch.testing.assert_close(rate_of(model).numbers, torch.tensor(40.0 * 26))
    full, plain = make(n=40), make(n=40, channel__kind="none")
    with torch.no_grad():  # the second Gaussian never
        for network, size in zip(full.channel.networks.values(), (2, 3, 3), strict=True):
            network[2].weight[2 * size :] = 0
            network[2].bias[2 * size :] = -100
        for a, b in zip(full.mlp_grid.parameters(), plain.mlp_grid.parameters(), strict=True):
            b.copy_(a[: len(b)])
    own = {name: value for name, value in plain.state_dict().items() if name.startswith("mlp_grid") or name == "units"}
    plain.load_resized({name: full.state_dict()[name] for name in plain.state_dict()} | own)
    torch.testing.assert_close(rate_of(full).bits, rate_of(plain).bits, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("units", ["values", "steps"])
def test_without_channels_and_masks_of_anchors_the_rate_is_that_of_hac(units):
    """Of the same anchors under the same noise; HAC counts its sample by what is visible, here all."""
    model = make(n=40, channel__kind="none", rate_term__anchor_gradient=False, rate_term__units=units)
    found = rate_of(model)
    found.bits.backward()
    gradients = {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}
    model.zero_grad()

    rates = HACAnchors.rate_model.fget(model)
    forecast = rates.forecast(model.context_rows(), torch.arange(40))
    values = torch.cat([model.features, model.log_scales.exp(), model.offsets.flatten(1)], dim=1)
    values = values + noise_of_rate(model) * model.shape.widened(forecast.steps)
    masks = model.masks()
    kept = masks.detach().amax(dim=1)
    bits, by_group = rates.rate(values, forecast, masks, kept)
    expected = AnchorRate.of(bits * kept.mean(), by_group, kept.sum() * values.shape[1], forecast)
    torch.testing.assert_close(found.bits, expected.bits, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.by_group, expected.by_group, rtol=1e-6, atol=0)
    assert torch.equal(found.own_bits, expected.own_bits)
    expected.bits.backward()
    assert {"mask_logits", "features", "mlp_grid.2.weight"} <= set(gradients)
    parameters = dict(model.named_parameters())
    for name, gradient in gradients.items():
        # Bits of an anchor that is off pull at its masks in HAC alone: here the anchor's mask multiplies them.
        at = kept > 0 if name == "mask_logits" else slice(None)
        small = 1e-5 * float(gradient.abs().max())  # float32 sums of small and large parts
        torch.testing.assert_close(gradient[at], parameters[name].grad[at], rtol=1e-4, atol=small)


def drawn(model):
    cam = front_camera()
    return RASTERIZER.render(model.gaussians(cam, RASTERIZER), cam, RasterOptions(grad2d=True))


def test_masks_learn_through_opacities_and_scales():
    model = make()
    model.train()
    model.noise = generator(0)
    result = drawn(model)
    inputs, selection = result.inputs, result.extras["anchors"]
    to_opacities, to_scales, found = torch.autograd.grad(
        result.image.square().sum(), [inputs.opacities, inputs.scales, model.mask_logits]
    )
    expected = torch.zeros_like(found).view(-1)
    expected[selection.offset_index()] = to_opacities * inputs.opacities + (to_scales * inputs.scales).sum(1)
    soft = torch.sigmoid(model.mask_logits.detach()).view(-1)
    torch.testing.assert_close(found.view(-1), expected.detach() * soft * (1 - soft), rtol=1e-3, atol=1e-5)


def test_masked_gaussians_change_no_pixel_but_are_counted():
    model = make()
    model.train()
    model.noise = generator(0)
    result = drawn(model)
    selection = result.extras["anchors"]
    masks = model.masks(selection.rows)
    assert len(selection.drawn) == int(((selection.opacities > 0) & (masks > 0)).sum())
    assert bool(((selection.opacities > 0) & (masks == 0)).any())
    stage = HACPlusStage(HACPlusConfig())
    volumes = result.inputs.scales.prod(dim=1)
    _, volume = stage.terms(model, result, 1)["volume"]
    torch.testing.assert_close(volume, volumes.sum() / int((selection.opacities > 0).sum()))
    moved = make()
    with torch.no_grad():
        moved.offsets[model.masks() == 0] += 7
    moved.train()
    moved.noise = generator(0)
    assert torch.equal(drawn(moved).image, result.image)


def test_the_loss_has_a_rate_and_no_mask_term():
    model = make()
    model.train()
    model.noise = generator(0)
    result = drawn(model)
    terms = HACPlusStage(HACPlusConfig()).extra_loss(model, result, 20_000)
    assert set(terms) == {"rate", "grid"}


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_neither_values_nor_rate_are_waited_for():
    check_nothing_is_waited_for(make().cuda())

"""The file of 3DGS: exact to the bit, quantised within stated errors, and safe against strangers."""

import functools
import math
import tracemalloc

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sw_kit.forged_files import forged

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, SplatwizardError, UserInputError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import apply_overrides
from sw_3dgs.config import ThreeDGSConfig
from sw_3dgs.method import ThreeDGS
from sw_codecs.models.gauge import canonical
from sw_codecs.models.quantized import lattice, reconstruct
from sw_codecs.models.settings import QuantizedSettings

QUANTIZED = [name for name in ThreeDGS.RATES if ThreeDGS.RATES[name]["codec.name"] == "gaussians-quantized"]


def random_model(n: int, degree: int = 3, active: int | None = None, seed: int = 0) -> GaussianModel:
    """Values spread as in a trained scene."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g)

    k = (degree + 1) ** 2
    rest = 0.05 * normal(n, k - 1, 3)
    if active is not None:
        rest[:, (active + 1) ** 2 - 1 :] = 0
    return GaussianModel(
        3 * normal(n, 3), normal(n, 1, 3), rest, 2 * normal(n), normal(n, 3) - 4, 3 * normal(n, 4),
        active_sh_degree=active,
    )  # fmt: skip


def method(rate: str | None = None, **values) -> ThreeDGS:
    overrides = {**(ThreeDGS.RATES[rate] if rate else {}), **values}
    return ThreeDGS(load_plugins(), apply_overrides(ThreeDGSConfig(), overrides, source="test"))


def settings_of(rate: str) -> QuantizedSettings:
    return QuantizedSettings.model_validate(method(rate).config.codec.settings)


def encoded(model: GaussianModel, rate: str | None = None, **values) -> bytes:
    writer = ContainerWriter("3dgs", ThreeDGS.version)
    method(rate, **values).encode(model, writer)
    return writer.to_bytes()


@functools.cache
def example(n: int, rate: str) -> bytes:
    """The file of n Gaussians, for tests that damage it many times."""
    return encoded(random_model(n), rate)


def decoded(data: bytes) -> GaussianModel:
    return ThreeDGS(load_plugins(), None).decode(ContainerReader(data))


def bits(model: GaussianModel) -> dict[str, bytes]:
    return {name: p.detach().numpy().tobytes() for name, p in model.named_parameters()}


@pytest.mark.parametrize(("degree", "active"), [(3, 3), (3, 1), (2, 0), (0, 0)])
def test_exact_mode_gives_every_bit_back(degree, active):
    model = random_model(100, degree, active)
    with torch.no_grad():
        model.opacity_logits[0], model.means[1, 0] = math.inf, math.nan
    found = decoded(encoded(model, "r6"))
    assert bits(found) == bits(model)
    assert (found.max_sh_degree, found.active_sh_degree) == (degree, active)


def test_exact_mode_costs_236_bytes_a_gaussian():
    assert len(encoded(random_model(1000))) == pytest.approx(236_000, rel=0.005)


def test_the_default_rate_point_compresses_and_values_alone_keep_every_bit():
    assert ThreeDGS.RATES[ThreeDGS.DEFAULT_RATE]["codec.name"] == "gaussians-quantized"
    assert ThreeDGSConfig().codec.name == "gaussians-exact"


@pytest.mark.parametrize("rate", QUANTIZED)
@pytest.mark.parametrize(("n", "degree", "active"), [(700, 3, 3), (40, 2, 1), (3, 0, 0), (1, 3, 0)])
def test_the_decoder_rebuilds_what_the_encoder_reconstructs(rate, n, degree, active):
    model = random_model(n, degree, active)
    sort = load_plugins().coders.load("octree").sort
    expected = reconstruct(lattice(model, settings_of(rate), sort))
    found = decoded(encoded(model, rate))
    assert bits(found) == bits(expected)
    assert (found.max_sh_degree, found.active_sh_degree) == (degree, active)


def test_encoding_leaves_the_model_alone_and_repeats_itself():
    model = random_model(200)
    before = model.digest()
    assert encoded(model, "r3") == encoded(model, "r3")
    assert model.digest() == before


def by_position(model: GaussianModel, reference: GaussianModel) -> torch.Tensor:
    """For each row of `reference`, the row of `model` that lies nearest."""
    return torch.cdist(reference.means.detach(), model.means.detach()).argmin(dim=1)


@pytest.mark.parametrize("rate", QUANTIZED)
def test_errors_stay_within_half_a_step(rate):
    model = random_model(400)
    with torch.no_grad():
        model.opacity_logits.clamp_(min=-5)
    codec = settings_of(rate)
    found = decoded(encoded(model, rate))
    assert found.num_rows == 400
    row = by_position(found, model)
    assert len(row.unique()) == 400
    with torch.no_grad():
        logits = (found.opacity_logits[row] - model.opacity_logits).abs().max()
        assert logits <= 0.5 * codec.opacity_step * 1.0001
        # An orthonormal colour transform: the three errors of a coefficient lie in a ball of sqrt(3) half steps.
        dc = (found.sh_dc[row] - model.sh_dc).norm(dim=-1).max()
        assert dc <= 0.5 * math.sqrt(3) * codec.dc_step * 1.0001
        rest = (found.sh_rest[row] - model.sh_rest).norm(dim=-1).max()
        assert rest <= 0.5 * math.sqrt(3) * codec.rest_step * 1.0001
    scales, quats = canonical(model.log_scales.detach().numpy(), model.quats.detach().numpy())
    assert np.abs(found.log_scales[row].detach().numpy() - scales).max() <= 0.5 * codec.scale_step * 1.0001
    found_quats = found.quats[row].detach().numpy()
    assert np.abs(found_quats[:, 1:] - quats[:, 1:]).max() <= 0.5 * codec.quat_step * 1.01
    np.testing.assert_allclose(np.linalg.norm(found_quats, axis=1), 1, atol=1e-6)


def test_rate_points_are_ordered_by_size():
    model = random_model(3000)
    sizes = [len(encoded(model, rate)) for rate in ThreeDGS.RATES]
    assert sizes == sorted(sizes)
    assert sizes[-2] < sizes[-1] / 5


def test_what_can_never_be_drawn_is_left_out():
    model = random_model(50)
    with torch.no_grad():
        model.opacity_logits.clamp_(min=-5)
        model.opacity_logits[3] = -6  # 0.0025, below 1/255
        model.means[7, 1] = math.nan
        model.sh_dc[8, 0, 0] = math.inf
        model.opacity_logits[9] = math.inf  # opacity 1
    found = decoded(encoded(model, "r4"))
    assert found.num_rows == 47
    assert found.opacities.max() == 1
    assert torch.isfinite(found.opacity_logits).all()


def test_coincident_gaussians_all_survive():
    model = random_model(64)
    with torch.no_grad():
        model.means.copy_(model.means[:1].expand(64, 3))
        model.opacity_logits.fill_(0.0)
    found = decoded(encoded(model, "r2"))
    assert found.num_rows == 64
    assert torch.equal(found.means, found.means[:1].expand(64, 3))


@pytest.mark.parametrize("rate", ["r1", "r6"])
def test_a_model_without_gaussians_has_a_file(rate):
    found = decoded(encoded(random_model(0), rate))
    assert found.num_rows == 0
    assert found.sh_rest.shape == (0, 15, 3)


@pytest.mark.parametrize(("name", "step"), [("log_scales", "scale"), ("sh_dc", "dc"), ("sh_rest", "rest")])
def test_a_value_beyond_the_lattice_is_an_error_and_is_not_clipped(name, step):
    model = random_model(10)
    with torch.no_grad():
        model.opacity_logits.fill_(0.0)
        getattr(model, name)[3] = 2e6  # at step 1: two million steps, which is fine
    found = decoded(encoded(model, "r4", **{f"codec.settings.{step}_step": 1.0}))
    torch.testing.assert_close(getattr(found, name).max().item(), 2e6, atol=2.0, rtol=0)
    with pytest.raises(UserInputError, match=rf"'{name}' .*codec\.settings\.{step}_step"):
        encoded(model, "r4", **{f"codec.{step}_step": 1e-6})


def test_decoding_takes_less_than_four_times_the_memory_of_the_model():
    n = 20_000
    data = encoded(random_model(n), "r3")
    reader, tool = ContainerReader(data), ThreeDGS(load_plugins(), None)
    tool.decode(ContainerReader(encoded(random_model(5), "r3")))  # imports are not what is measured
    tracemalloc.start()
    model = tool.decode(reader)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    held = sum(p.numel() * 4 for p in model.parameters())
    assert held == 236 * model.num_rows > 4_000_000
    assert peak < 4 * held


def test_a_few_bytes_never_stand_for_many_gaussians():
    model = random_model(1)
    many = GaussianModel(*(p.detach().expand(100_000, *p.shape[1:]) for p in model.parameters()))
    with pytest.raises(SplatwizardError, match="more than a reader accepts"):
        encoded(many, "r1", **{"codec.settings.position_bits": 8})
    # A stranger who writes it all the same is refused before anything is allocated.
    data = forged(encoded(random_model(30), "r1"), num_gaussians=200_000)
    tracemalloc.start()
    with pytest.raises(BitstreamError, match="may stand for at most"):
        decoded(data)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("rate", ["r1", "r5", "r6"])
def test_a_truncated_file_is_refused_at_every_length(rate):
    data = encoded(random_model(20), rate)
    for length in [*range(0, min(len(data), 400), 7), *np.linspace(400, len(data) - 1, 40).astype(int)]:
        with pytest.raises(BitstreamError):
            decoded(data[:length])


@pytest.mark.parametrize("rate", ["r3", "r6"])
@settings(max_examples=60, deadline=None)
@given(position=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_refused(rate, position, bit):
    data = bytearray(example(20, rate))
    data[int(position * len(data))] ^= 1 << bit
    with pytest.raises(BitstreamError):
        decoded(bytes(data))


@settings(max_examples=80, deadline=None)
@given(section=st.integers(0, 7), position=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255))
def test_a_section_forged_with_a_right_checksum_gives_a_model_or_a_bitstream_error(section, position, value):
    data = example(30, "r4")
    reader = ContainerReader(data)
    name = list(reader.sections)[section]
    changed = bytearray(reader.section(name))
    changed[int(position * len(changed))] = value
    try:
        model = decoded(forged(data, {name: bytes(changed)}))
    except BitstreamError:
        return
    assert model.num_rows == 30


@pytest.mark.parametrize(
    ("static", "message"),
    [
        ({"mode": "pickled"}, "mode"),
        ({"num_gaussians": 29}, "30"),
        ({"num_gaussians": 2**31}, "may stand for at most"),
        ({"num_gaussians": -1}, "num_gaussians"),
        ({"max_sh_degree": 1}, "more SH bands"),
        ({"active_sh_degree": 7}, "active_sh_degree"),
        ({"position_bits": 8}, "grid of 8 bits"),
        ({"position_bits": "many"}, "position_bits"),
        ({"width": [0.0, 1.0, 1.0]}, "position grid"),
        ({"width": [1e300, 1.0, 1.0]}, "position grid"),
        ({"top": [40, 4000, 1]}, "position grid"),
        ({"center": [1e39, 0.0, 0.0]}, "'means' is not finite"),
        ({"rest_step": 0.0}, "rest_step"),
        ({"scale_step": 1e9}, "scale_step"),
        ({"surprise": 1}, "surprise"),
    ],
)
def test_a_hostile_header_is_refused(static, message):
    with pytest.raises(BitstreamError, match=message):
        decoded(forged(example(30, "r4"), **static))


@pytest.mark.parametrize(
    ("static", "message"),
    [
        ({"num_gaussians": 31}, "shape"),
        ({"num_gaussians": 0}, "shape"),
        ({"max_sh_degree": 2}, "more|active_sh_degree|shape"),
        ({"active_sh_degree": True}, "active_sh_degree"),
    ],
)
def test_a_hostile_header_of_an_exact_file_is_refused(static, message):
    with pytest.raises(BitstreamError, match=message):
        decoded(forged(encoded(random_model(30), "r6"), **static))


@pytest.mark.parametrize(("rate", "section"), [("r4", "positions"), ("r4", "sh2"), ("r6", "sh_rest")])
def test_a_missing_section_is_named(rate, section):
    data = forged(encoded(random_model(5), rate), {section: None})
    with pytest.raises(BitstreamError, match=f"'{section}'.*missing"):
        decoded(data)


def test_an_unknown_layout_version_is_refused():
    writer = ContainerWriter("3dgs", 99)
    method("r6").encode(random_model(3), writer)
    with pytest.raises(BitstreamError, match="layout version 99"):
        decoded(writer.to_bytes())

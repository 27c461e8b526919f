"""The quantiser of the MPEG GSC exploration: half a step, ranges where it would clip, the same bytes twice."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sw_interchange.gsc_quant import RANGES, GscQuantCodec, clipped_attributes

from splatwizard_core.api import (
    BitstreamError,
    ContainerReader,
    ContainerWriter,
    GaussianModel,
    SplatwizardError,
    UserInputError,
)
from splatwizard_core.coding import limits
from splatwizard_core.plugins import load_plugins


@pytest.fixture(autouse=True)
def _without_gradients():
    with torch.no_grad():
        yield


def model_of(n: int = 300, degree: int = 3, seed: int = 0, spread: float = 2.0) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    return GaussianModel.from_tensors(
        spread * torch.randn(n, 3, generator=g), 0.4 * torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g), 2 * torch.randn(n, generator=g),
        0.3 * torch.randn(n, 3, generator=g) - 4, 3 * torch.randn(n, 4, generator=g),
    )  # fmt: skip


def written(model: GaussianModel, **settings) -> bytes:
    writer = ContainerWriter("gsc-quant", 1)
    with torch.no_grad():
        GscQuantCodec(load_plugins(), **settings).encode(model, writer)
    return writer.to_bytes()


def read(data: bytes) -> GaussianModel:
    return GscQuantCodec(load_plugins()).decode(ContainerReader(data))


def in_its_order(model: GaussianModel, decoded: GaussianModel) -> np.ndarray:
    """Rows of `model` in the order of `decoded`: nearest means, which here lie far apart."""
    return torch.cdist(decoded.means.double(), model.means.double()).argmin(dim=1).numpy()


@pytest.mark.parametrize(("position_bits", "bits"), [(14, 6), (18, 12)])
def test_no_value_is_off_by_more_than_half_a_step(position_bits: int, bits: int):
    model = model_of()
    decoded = read(written(model, position_bits=position_bits, bits=bits))
    rows = in_its_order(model, decoded)
    with torch.no_grad():
        step = 256 / (2**position_bits - 1)
        assert float((decoded.means - model.means[rows]).abs().max()) <= step / 2 + 1e-6
        unit = torch.nn.functional.normalize(model.quats, dim=1)
        for name, attribute, given in (
            ("sh_dc", "sh", model.sh_dc), ("sh_rest", "sh", model.sh_rest), ("opacity_logits", "opacity", None),
            ("log_scales", "scale", None), ("quats", "quaternion", unit),
        ):  # fmt: skip
            low, high = RANGES[attribute]
            given = getattr(model, name) if given is None else given
            error = float((getattr(decoded, name) - given[rows]).abs().max())
            assert error <= (high - low) / (2**bits - 1) / 2 + 1e-6, name


def test_the_ends_of_a_range_are_exact():
    model = model_of()
    with torch.no_grad():
        model.opacity_logits[:2] = torch.tensor([-7.0, 18.0])
        model.log_scales[0] = torch.tensor([-26.0, 4.0, 0.0])
    decoded = read(written(model, bits=7))
    assert (float(decoded.opacity_logits.min()), float(decoded.opacity_logits.max())) == (-7.0, 18.0)
    assert (float(decoded.log_scales.min()), float(decoded.log_scales.max())) == (-26.0, 4.0)


@pytest.mark.parametrize("settings", [{"position_bits": 14, "bits": 6}, {}, {"position_bits": 21, "bits": 16}])
@pytest.mark.parametrize("spread", [2.0, 400.0])
def test_what_was_decoded_gives_the_same_bytes(settings, spread):
    once = written(model_of(spread=spread), **settings)
    assert written(read(once), **settings) == once


def test_what_would_be_clipped_takes_the_range_of_its_values_alone():
    model = model_of()
    far = model_of()
    with torch.no_grad():
        far.means[0] = torch.tensor([300.0, -200.0, 0.0])
        far.log_scales[1, 0] = 5.0
    assert clipped_attributes(model) == []
    assert clipped_attributes(far) == ["position", "scale"]
    with pytest.raises(UserInputError, match="would clip position, scale"):
        written(far, range="fixed")
    reader = ContainerReader(written(far))
    assert reader.static["range_auto"] == ["position", "scale"]
    decoded = read(written(far))
    rows = in_its_order(far, decoded)
    width = float((far.means.max(0).values - far.means.min(0).values).max())
    with torch.no_grad():
        assert float((decoded.means - far.means[rows]).abs().max()) <= width / (2**18 - 1) / 2 + 1e-4  # float32 at 300
        low, high = float(far.log_scales.min()), 5.0
        assert float((decoded.log_scales - far.log_scales[rows]).abs().max()) <= (high - low) / 4095 / 2 + 1e-6
    # What is not clipped is coded as with the fixed ranges.
    near = model_of()
    with torch.no_grad():
        near.log_scales[1, 0] = 5.0
    auto, fixed = ContainerReader(written(near)), ContainerReader(written(model, range="fixed"))
    for name in ("position", "sh0", "sh1", "sh2", "sh3", "opacity", "rotation"):
        assert auto.section(name) == fixed.section(name), name


def test_more_bits_make_larger_files():
    model = model_of(400)
    rates = ((14, 6), (16, 8), (18, 12))
    sizes = [len(written(model, position_bits=position, bits=bits)) for position, bits in rates]
    assert sizes == sorted(sizes)
    assert len(set(sizes)) == 3


def test_a_model_may_be_larger_than_what_any_file_may_stand_for(monkeypatch):
    """The file that it is written to counts."""
    monkeypatch.setattr(limits, "FREE", 0)
    model = model_of()
    assert read(written(model)).num_rows == model.num_rows
    monkeypatch.setattr(limits, "EXPANSION", 1)
    with pytest.raises(SplatwizardError, match=r"of 70,800 bytes in [1-9][\d,]+ bytes of file"):
        written(model)


@pytest.mark.parametrize(("n", "degree"), [(0, 3), (1, 0), (2, 1), (5, 2)])
def test_small_models_come_back(n: int, degree: int):
    decoded = read(written(model_of(n, degree)))
    assert (decoded.num_rows, decoded.max_sh_degree) == (n, degree)


def test_values_that_are_not_finite_are_refused():
    model = model_of()
    with torch.no_grad():
        model.sh_rest[3, 2, 1] = torch.nan
    with pytest.raises(UserInputError, match="not finite"):
        written(model)


@pytest.mark.parametrize("change", [
    {"ranges": None}, {"ranges": {}}, {"num_gaussians": 299}, {"bits": 5}, {"position_bits": 9}, {"sh_degree": 2},
])  # fmt: skip
def test_a_header_that_lies_is_damage(change):
    writer = ContainerWriter("gsc-quant", 1)
    with torch.no_grad():
        GscQuantCodec(load_plugins()).encode(model_of(), writer)
    writer.static.update(change)
    reader = ContainerReader(writer.to_bytes())
    with pytest.raises(BitstreamError):  # noqa: PT012 (either may see it)
        GscQuantCodec(load_plugins()).decode(reader)
        reader.finish()  # a section that the header denies


def test_a_zero_quaternion_becomes_the_identity():
    model = model_of(10)
    with torch.no_grad():
        model.quats[4] = 0
    decoded = read(written(model))
    row = int(np.flatnonzero(in_its_order(model, decoded) == 4)[0])
    torch.testing.assert_close(decoded.quats[row], torch.tensor([1.0, 0, 0, 0]), atol=3e-4, rtol=0)

"""Classes of precision and the basis of SH: what they promise, and hostile ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatwizard_core.api import BitstreamError, GaussianModel
from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.plugins import load_plugins
from sw_codecs.models import precision, quantized, sh_basis
from sw_codecs.models.codecs import Quantized


def tinted(n: int) -> GaussianModel:
    """Gaussians of many sizes whose higher SH coefficients are multiples of one direction, nearly."""
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    rest = draw(n, 1) * draw(1, 24) + 0.02 * draw(n, 24)
    model = GaussianModel(
        draw(n, 3), draw(n, 1, 3), rest.unflatten(1, (8, 3)), draw(n) + 2, 2 * draw(n, 1) + 0.3 * draw(n, 3), draw(n, 4)
    )
    return model.requires_grad_(False)


@pytest.fixture(scope="module")
def model() -> GaussianModel:
    return tinted(600)


def written(model: GaussianModel, **settings) -> ContainerWriter:
    writer = ContainerWriter("3dgs", 1)
    Quantized(load_plugins(), **settings).encode(model, writer)
    return writer


def read(data: bytes) -> GaussianModel:
    return Quantized(load_plugins()).decode(ContainerReader(data, "file"))


def test_classes_are_half_octaves_of_the_step_about_the_median():
    weights = np.array([0.0, 1e-9, 1 / 16, 1.0, 1.0, 4.0, 1e9])
    assert precision.classes_of(weights, 0.5).tolist() == [-4, -4, -4, 0, 0, 2, 4]
    assert precision.factors(np.array([-4, -1, 0, 1, 2, 4])).tolist() == pytest.approx(
        [4, 2**0.5, 1, 2**-0.5, 0.5, 0.25]
    )
    assert precision.classes_of(np.zeros(3), 0.5).tolist() == [-4] * 3


@given(st.integers(0, 40), st.integers(1, 2))
def test_from_the_basis_is_the_inverse_of_to_the_basis(seed, degree):
    rng = np.random.default_rng(seed)
    width = 3 * ((degree + 1) ** 2 - 1)
    rest = rng.normal(size=(50, width)) @ rng.normal(size=(width, width))
    basis = sh_basis.fit([rest[:20], rest[20:]], np.ones(50))
    symbols = np.rint(basis.to(rest) / 0.01).astype(np.int32)
    error = sh_basis.from_basis(symbols, basis.matrix) * (0.01 / sh_basis.UNIT) - rest
    assert np.sqrt((error**2).mean()) == pytest.approx(0.01 / 12**0.5, rel=0.1)


def test_a_basis_saves_what_coefficients_have_in_common_and_few_gaussians_have_none(model):
    plain, own = (sum(v for k, v in written(model, sh_basis=on).sections.items() if k[:2] in ("sh", "ba"))
                  for on in (False, True))  # fmt: skip
    assert own < 0.6 * plain
    few = written(tinted(5), sh_basis=True)
    assert "basis" not in few.sections
    assert "sh_basis" not in few.static


def test_weights_of_pictures_go_before_footprints(model):
    unlike = tinted(600)
    unlike.importance = torch.arange(600.0)
    by_size, by_weight = (written(m, precision_power=0.4) for m in (model, unlike))
    assert by_size.to_bytes() != by_weight.to_bytes()
    finest = quantized.lattice(unlike, Quantized(load_plugins(), precision_power=0.4).settings, _in_order).classes
    assert finest[-1] == 1
    assert finest[1] == -4


def _in_order(cells):
    return np.arange(len(cells))


@pytest.mark.parametrize("settings", [{}, {"prefixes": 3}])
def test_errors_follow_the_class(model, settings):
    weighed = tinted(600)
    weighed.importance = torch.where(torch.arange(600) % 2 == 0, 1.0, 1e6)
    found = read(written(weighed, precision_power=0.4, sh_basis=True, rest_step=0.01, **settings).to_bytes())
    row = torch.cdist(weighed.means, found.means.detach()).argmin(dim=1)
    error = (found.sh_rest.detach()[row] - weighed.sh_rest).square().mean(dim=(1, 2)).sqrt()
    assert float(error[1::2].mean()) < 0.35 * float(error[::2].mean())


@pytest.mark.parametrize(
    ("section", "spoilt", "told"),
    [("basis", bytes(10), "a basis of 24 coefficients has 576"), ("precision", None, "class of precision is beyond 4")],
)
def test_hostile_sections_are_refused(model, section, spoilt, told, monkeypatch):
    if spoilt is None:
        monkeypatch.setattr(precision, "MOST", 3)
        data = written(model, precision_power=1.0, sh_basis=True).to_bytes()
        monkeypatch.undo()
        assert read(data)
        monkeypatch.setattr(precision, "MOST", 2)
        told = "class of precision is beyond 2"
    else:
        add = ContainerWriter.add
        monkeypatch.setattr(
            ContainerWriter, "add", lambda self, name, data: add(self, name, spoilt if name == section else data)
        )
        data = written(model, precision_power=1.0, sh_basis=True).to_bytes()
    with pytest.raises(BitstreamError, match=told):
        read(data)


def test_a_lattice_keeps_its_rows_together(model):
    found = quantized.lattice(model, Quantized(load_plugins(), precision_power=0.4).settings, _in_order)
    part = found.part(np.array([3, 1]))
    whole, some = (
        quantized.reconstruct(found),
        quantized.reconstruct(replace(part, layout=found.layout.model_copy(update={"num_gaussians": 2}))),
    )
    assert torch.equal(whole.quats[[3, 1]], some.quats)

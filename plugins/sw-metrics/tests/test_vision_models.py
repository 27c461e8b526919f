"""Metrics through other people's packages: published values where these are installed, what to install where not."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import types

import pytest
import torch
from sw_metrics import vision_models
from sw_metrics.vision_models import CVVDP, FLIP, GMSD, HAARPSI, METRICS, MS_SSIM, FlipSettings, Packaged

from splatwizard_core.api import CapabilityError, ConfigError, MetricSetup, ShapeError, SplatwizardError

CPU = torch.device("cpu")


def needs(package: str) -> pytest.MarkDecorator:
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return pytest.mark.skip(reason=f"{package} is an extra of sw-metrics")
    return pytest.mark.filterwarnings("ignore")


def setup(**settings) -> MetricSetup:
    return MetricSetup(CPU, settings)


def flat(*rgb: float, size: int = 64) -> torch.Tensor:
    return torch.tensor(rgb)[:, None, None].expand(3, size, size).contiguous()


@needs("flip-evaluator")
@pytest.mark.parametrize(("a", "b", "size", "value"), [
    ((0, 0, 0), (1, 1, 1), 64, 0.967345), ((0.5,) * 3, (0.6,) * 3, 64, 0.285045), ((1, 0, 0), (0, 1, 0), 64, 0.98663),
    ((0, 0, 1), (0, 1, 0), 64, 1.0), ((0, 0, 0), (1, 1, 1), 1, 0.967392), ((0.2,) * 3, (0.2,) * 3, 64, 0.0),
])  # fmt: skip
def test_flip_of_flat_pictures(a, b, size, value):
    found = FLIP.prepare(setup())
    assert found.made_with["ppd"] == "67"
    truth, render = (flat(*map(float, each), size=size) for each in (a, b))
    assert found.compute(render, truth) == pytest.approx(value, abs=1e-4)


@needs("flip-evaluator")
def test_flip_depends_on_the_distance_and_refuses_what_is_no_number():
    g = torch.Generator().manual_seed(0)
    a, b = torch.rand(3, 40, 40, generator=g), torch.rand(3, 40, 40, generator=g)
    near, far = (FLIP.prepare(setup(flip={"ppd": ppd})).compute(a, b) for ppd in (30, 120))
    assert near != pytest.approx(far, abs=1e-3)
    with pytest.raises(ConfigError, match="ppd"):
        FLIP.prepare(setup(flip={"ppd": 0}))
    with pytest.raises(SplatwizardError, match="not finite"):
        FLIP.prepare(setup()).compute(a * torch.nan, b)


def test_a_library_that_ends_the_process_is_an_error_of_the_metric(monkeypatch):
    def evaluate(*_, **__):
        raise SystemExit(7)

    compute, _ = vision_models._flip(types.SimpleNamespace(evaluate=evaluate), setup())
    with pytest.raises(SplatwizardError, match="gave up with status 7"):
        compute(flat(0, 0, 0), flat(1, 1, 1))


@needs("piq")
def test_equal_pictures_are_best_and_noise_is_worse():
    g = torch.Generator().manual_seed(1)
    truth = torch.rand(3, 170, 180, generator=g)
    render = (truth + 0.1 * torch.randn(truth.shape, generator=g)).clamp(0, 1)
    for name in ("ms_ssim", "haarpsi", "fsim", "vsi"):
        compute = METRICS[name].prepare(setup()).compute
        assert compute(truth, truth) == pytest.approx(1, abs=1e-5), name
        assert compute(render, truth) < 0.999, name
    assert GMSD.prepare(setup()).compute(truth, truth) == pytest.approx(0, abs=1e-5)
    assert GMSD.prepare(setup()).compute(render, truth) > 0.01


@needs("piq")
def test_the_multi_scale_similarity_is_that_of_torchmetrics():
    metric = pytest.importorskip("torchmetrics.functional.image")
    g = torch.Generator().manual_seed(2)
    truth = torch.rand(3, 200, 190, generator=g)
    render = (truth + 0.05 * torch.randn(truth.shape, generator=g)).clamp(0, 1)
    betas = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
    theirs = metric.multiscale_structural_similarity_index_measure(
        render[None], truth[None], data_range=1.0, kernel_size=11, sigma=1.5, betas=betas
    )
    assert MS_SSIM.prepare(setup()).compute(render, truth) == pytest.approx(float(theirs), abs=5e-3)


@needs("piq")
@pytest.mark.parametrize(("metric", "side"), [(MS_SSIM, 161), (HAARPSI, 16)])
def test_small_pictures_have_no_value(metric: Packaged, side: int):
    compute = metric.prepare(setup()).compute
    with pytest.raises(CapabilityError, match=f"too-small: .* at least {side} pixels"):
        compute(torch.rand(3, side - 1, 200), torch.rand(3, side - 1, 200))
    picture = torch.rand(3, side, 200, generator=torch.Generator().manual_seed(3))
    assert compute(picture, picture) == pytest.approx(1, abs=1e-5)


@needs("cvvdp")
@pytest.mark.skipif(importlib.util.find_spec("pycvvdp") is None, reason="cvvdp is an extra of sw-metrics")
def test_cvvdp_of_equal_pictures_is_ten_and_the_order_counts():
    try:
        found = CVVDP.prepare(setup())
    except CapabilityError as error:
        pytest.skip(str(error))
    g = torch.Generator().manual_seed(4)
    a = torch.rand(3, 64, 64, generator=g)
    b = (a + 0.2 * torch.randn(a.shape, generator=g)).clamp(0, 1)
    assert found.made_with["display"] == "standard_fhd"
    assert found.compute(a, a) == pytest.approx(10, abs=1e-3)
    assert found.compute(a, b) < 9.9
    assert found.compute(a, b) != found.compute(b, a)


@pytest.mark.parametrize("name", METRICS)
def test_without_its_package_a_metric_says_what_to_install(monkeypatch, name: str):
    def absent(package: str) -> str:
        raise importlib.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    metric = METRICS[name]
    with pytest.raises(CapabilityError, match=re.escape(f"package-missing: {metric.install}")):
        metric.prepare(setup())
    assert metric.identity(setup()) is None


def test_a_package_that_cannot_be_imported_says_so():
    broken = Packaged("piq", "torch", "a_module_that_nobody_has", lambda module, given: (lambda a, b: 0.0, {}))
    with pytest.raises(CapabilityError, match="a_module_that_nobody_has"):
        broken.prepare(setup())


def test_shapes_are_checked_before_the_package_sees_them():
    metric = Packaged("piq", "torch", "torch", lambda module, given: (lambda a, b: 0.0, {}))
    assert metric.prepare(setup()).compute(flat(0, 0, 0), flat(1, 1, 1)) == 0
    with pytest.raises(ShapeError):
        metric.prepare(setup()).compute(torch.zeros(3, 4, 4), torch.zeros(3, 4, 5))
    assert FlipSettings().ppd == 67

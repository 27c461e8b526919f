"""LPIPS in its three forms, on weights made for the test: against the definition written out, and what is absent."""

import importlib.util
import logging
import re
import socket
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F  # noqa: N812 (its usual name)
from sw_metrics import perceptual
from sw_metrics.lpips_weights import BACKBONES
from sw_metrics.perceptual import ALEX, SMALLEST, VGG, VGG_3DGS, install_command, not_available
from torch import Tensor

from splatwizard_core.errors import CapabilityError, ConfigError, ShapeError, UserInputError
from splatwizard_core.evaluation.evaluate import evaluate
from splatwizard_core.evaluation.metrics import MetricSetup, check_settings, metric_identities, unavailable
from splatwizard_core.plugins import load_plugins

# Not importorskip: the package imports only once torchvision does, which is what is tested.
if importlib.util.find_spec("lpips") is None:
    pytest.skip("LPIPS is the extra sw-metrics[lpips]", allow_module_level=True)

CPU = torch.device("cpu")


def setup_with(folder: Path, device: str = "cpu") -> MetricSetup:
    """As `--set metrics.lpips.weights=FOLDER` makes it."""
    return MetricSetup(torch.device(device), {"lpips": {"weights": str(folder)}})


FORMS = {"lpips_vgg_3dgs": VGG_3DGS, "lpips_vgg": VGG, "lpips_alex": ALEX}

# Channel statistics of the input layer, and for each backbone: what follows a convolution, where features are taken.
SHIFT = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
SCALE = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
STRIDE_PADDING = {"vgg": {}, "alex": {0: (4, 2), 3: (1, 2)}}  # others: stride 1, padding 1
TAPS = {"vgg": (2, 7, 14, 21, 28), "alex": (0, 3, 6, 8, 10)}  # features are taken after the ReLU of these convolutions
POOLED_AFTER = {"vgg": (2, 7, 14, 21), "alex": (0, 3)}
POOL = {"vgg": (2, 2), "alex": (3, 2)}  # kernel, stride


def direct_lpips(net: str, state: dict[str, Tensor], heads: list[Tensor], a: Tensor, b: Tensor) -> float:
    """The definition (arXiv 1801.03924, eq. 1): unit-length features, squared difference, weighted, mean, sum."""

    def features(image: Tensor) -> list[Tensor]:
        x = ((image - SHIFT) / SCALE)[None].double()
        found = []
        for index in BACKBONES[net].layers:
            stride, padding = STRIDE_PADDING[net].get(index, (1, 1))
            weight, bias = state[f"features.{index}.weight"].double(), state[f"features.{index}.bias"].double()
            x = F.relu(F.conv2d(x, weight, bias, stride=stride, padding=padding))
            if index in TAPS[net]:
                found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
            if index in POOLED_AFTER[net]:
                x = F.max_pool2d(x, *POOL[net])
        return found

    total = 0.0
    for x, y, head in zip(features(a), features(b), heads, strict=True):
        total += float(F.conv2d((x - y).square(), head.double()).mean())
    return total


def shipped_heads(net: str) -> list[Tensor]:
    """The linear heads that the package carries."""
    (package,) = importlib.util.find_spec("lpips").submodule_search_locations
    folder = Path(package) / "weights" / "v0.1"
    state = torch.load(folder / f"{net}.pth", map_location="cpu", weights_only=True)
    return [state[f"lin{k}.model.1.weight"] for k in range(5)]


def pictures(seed: int = 0, height: int = 48, width: int = 56) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 7, 7, generator=generator)
    truth = F.interpolate(coarse, (height, width), mode="bicubic", align_corners=False)[0].clamp(0, 1)
    return (truth + 0.1 * torch.randn(truth.shape, generator=generator)).clamp(0, 1), truth


@pytest.fixture(scope="module")
def loads() -> list[str]:
    """Nets that were loaded while `forms` was made."""
    return []


@pytest.fixture(scope="module")
def forms(lpips_folder: Path, loads: list[str]):
    """name -> the prepared metric."""
    setup, real = setup_with(lpips_folder), perceptual._network
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(perceptual, "_network", lambda net, setup: loads.append(net) or real(net, setup))
        return {name: form.prepare(setup) for name, form in FORMS.items()}


@pytest.mark.parametrize("name", FORMS)
def test_each_form_equals_the_definition_written_out(name: str, forms, lpips_folder: Path):
    form = FORMS[name]
    state = torch.load(lpips_folder / BACKBONES[form.net].file_name, weights_only=True)
    render, truth = pictures()
    mapped = [2 * image - 1 if form.to_signed else image for image in (render, truth)]
    expected = direct_lpips(form.net, state, shipped_heads(form.net), *mapped)
    # float32 through 13 convolutions, against float64
    assert forms[name].compute(render, truth) == pytest.approx(expected, rel=2e-5)


def test_the_forms_differ_by_the_net_and_the_input_map_alone(forms):
    assert [(form.net, form.to_signed) for form in FORMS.values()] == [("vgg", False), ("vgg", True), ("alex", True)]
    render, truth = pictures()
    # The correct form of x is the 3DGS form of 2 x - 1: the same network, another range.
    same = forms["lpips_vgg_3dgs"].compute(2 * render - 1, 2 * truth - 1)
    assert forms["lpips_vgg"].compute(render, truth) == pytest.approx(same, rel=1e-6)
    values = {name: form.compute(render, truth) for name, form in forms.items()}
    assert len({round(v, 4) for v in values.values()}) == 3


def test_the_two_forms_of_one_net_share_it(forms, loads: list[str]):
    assert len(forms) == 3
    assert loads == ["vgg", "alex"]


@pytest.mark.parametrize("name", FORMS)
def test_the_distance_is_zero_for_equal_pictures_positive_symmetric_and_grows_with_the_error(name: str, forms):
    compute = forms[name].compute
    render, truth = pictures()
    half = truth + (render - truth) / 4
    assert compute(truth, truth) == 0
    assert 0 < compute(half, truth) < compute(render, truth) < 5  # unit features: at most 4 per tap times the head
    assert compute(render, truth) == pytest.approx(compute(truth, render), rel=1e-5)


def test_what_the_values_depend_on_is_told(forms, lpips_folder: Path):
    import hashlib

    told = forms["lpips_alex"]
    data = (lpips_folder / "alexnet-owt-7be5be79.pth").read_bytes()
    assert told.made_with == {
        "lpips": "0.1.4", "weights": "alexnet-owt-7be5be79.pth", "weights_sha256": hashlib.sha256(data).hexdigest(),
    }  # fmt: skip
    assert not told.verified  # made for this test: not the published file, and the record is flagged so


def test_getting_ready_moves_no_random_stream_and_asks_no_network(lpips_folder: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> None:
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    before = torch.get_rng_state()
    ALEX.prepare(setup_with(lpips_folder))
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_the_smallest_picture_is_one_that_leaves_every_layer_something(net: str, forms):
    compute = next(forms[name] for name, form in FORMS.items() if form.net == net).compute
    side = SMALLEST[net]
    assert compute(*pictures(1, side, side)) > 0
    with pytest.raises(CapabilityError, match=f"too-small.*{side} pixels"):
        compute(*pictures(1, side - 1, side + 9))


def test_wrong_shapes_are_refused(forms):
    with pytest.raises(ShapeError, match=r"need two \[3,H,W\]"):
        forms["lpips_vgg"].compute(torch.zeros(3, 40, 40), torch.zeros(3, 40, 41))


class TestWithoutWeights:
    """What happens where there are none."""

    def test_the_value_is_null_and_the_reason_says_how_to_bring_them(self):
        for form in FORMS.values():
            with pytest.raises(CapabilityError, match=r"^weights-missing: .*\.pth is needed: .*get it from https://.*"):
                form.prepare(MetricSetup(CPU))

    def test_an_evaluation_goes_on_and_keeps_the_reason(self, tmp_path: Path):
        from splatwizard_core.rendering.rasterizer import RasterOptions
        from splatwizard_core.scene.dataset import SceneOptions
        from splatwizard_core.scene.loading import load_scene

        plugins = load_plugins()
        scene = load_scene("demo:tiny", SceneOptions(), plugins)
        result = evaluate(
            _Nothing(), scene.test, _Black(), plugins,  # type: ignore[arg-type]
            device=CPU, options=RasterOptions(background=torch.zeros(3)), metrics=["lpips_vgg_3dgs", "psnr"],
        )  # fmt: skip
        metric = result.metrics["lpips_vgg_3dgs"]
        assert (metric.mean, metric.per_view, metric.direction) == (None, [], "lower")
        assert (metric.reason or "").startswith("weights-missing")
        assert result.metrics["psnr"].mean is not None

    def test_one_line_warns_of_both_nets(self, lpips_folder: Path):
        warning = not_available(None) or ""
        assert "\n" not in warning
        assert "vgg16-397923af.pth" in warning
        assert "alexnet-owt-7be5be79.pth" in warning
        assert "--set metrics.lpips.weights=DIR" in warning
        assert not_available(lpips_folder) is None

    def test_without_the_package_the_extra_is_named(self, monkeypatch: pytest.MonkeyPatch, lpips_folder: Path):
        import importlib.metadata

        def absent(name: str) -> str:
            raise importlib.metadata.PackageNotFoundError(name)

        monkeypatch.setattr(importlib.metadata, "version", absent)
        with pytest.raises(CapabilityError, match=r"^package-missing: .*pip install .*lpips"):
            VGG.prepare(setup_with(lpips_folder))
        assert install_command() in (not_available(lpips_folder) or "")


def test_weights_that_are_brought_change_what_a_finished_evaluation_is_asked_for(lpips_folder: Path):
    registry = load_plugins().metrics
    without = metric_identities(registry, MetricSetup(CPU))
    brought = metric_identities(registry, setup_with(lpips_folder))
    assert without["lpips_vgg"] is None
    assert "vgg16-397923af.pth" in (brought["lpips_vgg"] or "")
    assert without["psnr"] == brought["psnr"] is not None


def test_torch_hubs_cache_is_searched_too(lpips_folder: Path, empty_hub: Path, caplog: pytest.LogCaptureFixture):
    empty_hub.mkdir(parents=True)
    name = BACKBONES["alex"].file_name
    (empty_hub / name).symlink_to(lpips_folder / name)
    with caplog.at_level(logging.WARNING):
        assert ALEX.prepare(MetricSetup(CPU)).compute(*pictures()) > 0
    (empty_hub / name).unlink()
    (empty_hub / name).write_bytes(b"half a download")
    with pytest.raises(CapabilityError, match=r"^weights-missing: .*does not hold the weights"):
        ALEX.prepare(MetricSetup(CPU))


def test_the_settings_are_checked_with_the_nearest_key(lpips_folder: Path):
    registry = load_plugins().metrics
    assert check_settings(registry, {"lpips": {"weights": "."}}) == {"lpips": {"weights": str(Path.cwd())}}
    assert check_settings(registry, {}) == {}
    for wrong, told in (
        ({"lpips": {"wieghts": "x"}}, "unknown key 'metrics.lpips.wieghts': did you mean 'metrics.lpips.weights'?"),
        ({"lpisp": {"weights": "x"}}, "unknown key 'metrics.lpisp.weights': did you mean 'metrics.lpips'?"),
        ({"lpips": {"weights": "3", "x": "y"}}, "unknown key 'metrics.lpips.x'"),
        ({"lpips": {"weights": 3}}, "bad value 3 for 'metrics.lpips.weights'"),
    ):
        with pytest.raises(ConfigError, match=re.escape(told)):
            check_settings(registry, wrong)


def test_all_forms_say_once_before_the_work_what_is_missing(tmp_path: Path, lpips_folder: Path):
    entries = [entry for entry in load_plugins().metrics if entry.distribution == "sw-metrics"]
    (line,) = unavailable(entries, MetricSetup(CPU))
    assert line.startswith("LPIPS is not available")
    assert unavailable(entries, setup_with(lpips_folder)) == []
    with pytest.raises(UserInputError, match="holds neither"):
        unavailable(entries, setup_with(tmp_path))


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", FORMS)
def test_the_values_on_a_gpu_are_those_of_the_cpu(name: str, lpips_folder: Path):
    render, truth = torch.rand(2, 3, 64, 80, generator=torch.Generator().manual_seed(0))
    on = {
        d: FORMS[name].prepare(setup_with(lpips_folder, d)).compute(render.to(d), truth.to(d)) for d in ("cpu", "cuda")
    }
    assert on["cuda"] == pytest.approx(on["cpu"], rel=5e-3)  # TF32 convolutions


class _Nothing(torch.nn.Module):
    def gaussians(self, camera: object, rasterizer: object) -> None:
        return None


class _Black:
    """Draws nothing."""

    def render(self, gaussians: None, camera, options):
        from types import SimpleNamespace

        image = options.background[:, None, None].expand(3, camera.height, camera.width)
        return SimpleNamespace(image=image, visible=torch.zeros(1, dtype=torch.bool), inputs=[])

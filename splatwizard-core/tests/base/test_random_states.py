"""Random generators and the order of sums: set within a block, and afterwards as before."""

import os
import random

import numpy as np
import pytest
import torch

from splatwizard_core.base.random_states import seeded
from splatwizard_native import ForeseenError


def drawn() -> list[float]:
    return [random.random(), float(np.random.rand()), float(torch.rand(()))]


def test_a_seed_holds_in_the_block_alone():
    state = drawn()
    with seeded(3):
        first = drawn()
    with seeded(3):
        assert drawn() == first
    with seeded(4):
        assert drawn() != first
    assert drawn() != state


@pytest.mark.parametrize("warn_only", [False, True])
@pytest.mark.parametrize("before", [False, True])
def test_torch_is_asked_for_one_order_in_the_block_alone(before, warn_only, monkeypatch):
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG", raising=False)
    torch.use_deterministic_algorithms(before, warn_only=warn_only)
    try:
        with seeded(0, deterministic=True):
            assert torch.are_deterministic_algorithms_enabled()
            assert not torch.is_deterministic_algorithms_warn_only_enabled()
            assert not torch.utils.deterministic.fill_uninitialized_memory
            assert os.environ["CUBLAS_WORKSPACE_CONFIG"] == ":4096:8"
        assert torch.are_deterministic_algorithms_enabled() == before
        assert torch.is_deterministic_algorithms_warn_only_enabled() == warn_only
        assert torch.utils.deterministic.fill_uninitialized_memory
        with seeded(0):
            assert torch.are_deterministic_algorithms_enabled() == before
    finally:
        torch.use_deterministic_algorithms(False)


def test_an_environment_in_which_products_have_no_order_is_refused_by_name(monkeypatch):
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":0:0")
    with (
        pytest.raises(ForeseenError, match="deterministic=true: CUBLAS_WORKSPACE_CONFIG is ':0:0'"),
        seeded(0, deterministic=True),
    ):
        raise AssertionError("the block begins")
    assert not torch.are_deterministic_algorithms_enabled()
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":16:8")
    with seeded(0, deterministic=True):
        assert torch.are_deterministic_algorithms_enabled()

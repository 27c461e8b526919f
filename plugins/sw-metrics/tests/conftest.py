"""LPIPS weights that no test may find anywhere but where it puts them."""

from pathlib import Path

import pytest
from lpips_backbones import write_backbones


@pytest.fixture(scope="session")
def lpips_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for metrics.lpips.weights."""
    return write_backbones(tmp_path_factory.mktemp("lpips-weights"))


@pytest.fixture(autouse=True)
def empty_hub(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test may depend on what this machine once downloaded, but for those of golden values, which looked before."""
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    home = tmp_path_factory.mktemp("torch-home")
    monkeypatch.setenv("TORCH_HOME", str(home))
    return home / "hub" / "checkpoints"

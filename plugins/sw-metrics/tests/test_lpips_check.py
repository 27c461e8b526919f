"""Check of what LPIPS needs on a machine."""

import hashlib
import importlib.metadata
import importlib.util
import re

import pytest
from sw_datasets.downloads.fetch import Job
from sw_datasets.downloads.registry import parse_registry
from sw_metrics import lpips_weights
from sw_metrics.check import check_lpips
from sw_metrics.perceptual import install_command

from splatwizard_core.plugins import load_plugins


def test_the_check_is_registered_and_waits_for_torch():
    entry = load_plugins().checks.entry("LPIPS")
    assert entry.load() is check_lpips
    assert (entry.declared["group"], entry.declared["needs"]) == ("metrics", "torch")


def test_weights_of_lpips_are_known_by_their_checksum(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    backbones = lpips_weights.BACKBONES
    content = b"weights"
    name = f"vgg-{hashlib.sha256(content).hexdigest()[:8]}.pth"
    monkeypatch.setitem(backbones, "vgg", lpips_weights.Backbone(name, {}))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    (folder / name).write_bytes(content)
    (folder / backbones["alex"].file_name).write_bytes(b"half a file")
    checks = {c.name: c for c in check_lpips()}
    assert checks["LPIPS weights, vgg"].state == "ok"
    broken = checks["LPIPS weights, alex"]
    assert broken.state == "broken"
    assert broken.mend == (
        f"curl -L --create-dirs -o {tmp_path}/hub/checkpoints/{backbones['alex'].file_name} {backbones['alex'].address}"
    )
    (folder / name).unlink()
    assert {c.name: c.state for c in check_lpips()}["LPIPS weights, vgg"] == "missing"
    assert not any(c.needed for c in checks.values())


def test_weights_that_were_made_from_a_package_are_known_by_their_first_numbers(tmp_path, monkeypatch):
    import torch
    from lpips_backbones import random_state
    from sw_metrics.packaged_weights import PRINTED

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    path = tmp_path / "hub" / "checkpoints" / lpips_weights.BACKBONES["alex"].file_name
    path.parent.mkdir(parents=True)
    state = random_state("alex")
    for first, expected in ((state["features.0.weight"][0, 0, 0, :3].clone(), "broken"),
                            (torch.tensor(PRINTED["alex"]["features.0.weight"]), "ok")):  # fmt: skip
        state["features.0.weight"][0, 0, 0, :3] = first
        torch.save(state, path)
        check = next(c for c in check_lpips() if c.name == "LPIPS weights, alex")
        assert (check.state, "checksum" in check.detail) == (expected, True)


def test_a_package_lpips_that_is_not_installed_is_an_extra(monkeypatch):
    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr("sw_metrics.perceptual.importlib.metadata.version", absent)
    found = check_lpips()[0]
    assert (found.state, found.mend) == ("missing", install_command())


@pytest.mark.parametrize(
    ("version", "command"),
    [
        ("2.13.0", "pip install lpips torch==2.13.0 torchvision==0.28.0"),
        ("2.4.1+cpu", "pip install lpips torch==2.4.1 torchvision==0.19.1"),
        ("2.14.0a0+git12", "pip install 'sw-metrics[lpips]'"),
    ],
)
def test_the_command_names_the_torchvision_of_the_torch_that_is_there(version, command, monkeypatch):
    monkeypatch.setattr("sw_metrics.perceptual.torch.__version__", version)
    assert install_command() == command


def test_the_torchvision_that_is_installed_is_the_one_that_would_be_named():
    told = re.search(r"torchvision==(\S+)", install_command())
    if told is None or importlib.util.find_spec("torchvision") is None:
        pytest.skip("a torch of one's own, or no torchvision")
    assert importlib.metadata.version("torchvision").partition("+")[0] == told[1]


def test_sw_data_fetch_knows_the_backbones_and_where_they_are_looked_for(monkeypatch, tmp_path):
    (dataset,) = parse_registry(load_plugins().downloads.entry("lpips").load()(), "lpips")
    assert [file.name for file in dataset.files] == [b.file_name for b in lpips_weights.BACKBONES.values()]
    assert all(file.plain and file.name.endswith(f"-{file.sha256}.pth") for file in dataset.files)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    assert lpips_weights.find_weights("vgg", None) is None
    job = Job(dataset, dataset.files[0], ())
    job.target(tmp_path).mkdir(parents=True)
    (job.target(tmp_path) / dataset.files[0].name).write_bytes(b"weights")
    assert job.is_there(tmp_path)
    assert lpips_weights.find_weights("vgg", None) == job.target(tmp_path) / dataset.files[0].name

"""Check of what LPIPS needs on a machine."""

import hashlib
import importlib.metadata

from sw_metrics import lpips_weights
from sw_metrics.check import check_lpips

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


def test_a_package_lpips_that_is_not_installed_is_an_extra(monkeypatch):
    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr("sw_metrics.perceptual.importlib.metadata.version", absent)
    found = check_lpips()[0]
    assert (found.state, found.mend) == ("missing", "pip install 'sw-metrics[lpips]'")

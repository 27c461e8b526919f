"""torchvision is imported also where its compiled operators cannot be."""

import importlib
import importlib.util

import pytest
from forked_children import run_python
from sw_metrics.torchvision_import import import_torchvision

needs_torchvision = pytest.mark.skipif(
    importlib.util.find_spec("torchvision") is None, reason="torchvision comes with sw-metrics[lpips]"
)


@needs_torchvision
def test_a_new_process_gets_a_whole_package_and_the_same_one_again():
    program = """
import warnings
warnings.simplefilter("error")
from sw_metrics.torchvision_import import import_torchvision
module = import_torchvision()
assert module is import_torchvision()
import torch, torchvision
assert torchvision is module
torchvision.models.alexnet(weights=None)
print(torch.ops.torchvision.nms.default._schema)
"""
    done = run_python("-c", program)
    assert done.returncode == 0, done.stderr
    assert "torchvision::nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor" in done.stdout


def test_another_failure_is_an_import_error_with_its_reason(monkeypatch: pytest.MonkeyPatch):
    def fail(name: str) -> None:
        raise RuntimeError("built for another torch")

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(ImportError, match=r"torchvision does not work with torch .*: built for another torch"):
        import_torchvision.__wrapped__()

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from wisp_scenes import made_up

from sw_wisp.numbers import BASE_STEPS, NUMBERS
from sw_wisp.pyramid import walked_features

pytestmark = pytest.mark.cuda


@pytest.mark.parametrize(("subsets", "planes"), [(1, 0), (3, 1)])
def test_features_are_the_same_integers_on_cuda(subsets, planes):
    scene = made_up(20_000, subsets=subsets, planes=planes)
    values = scene.values / torch.tensor(BASE_STEPS)
    labels = None if scene.subsets is None else torch.from_numpy(scene.subsets)
    found = []
    for device in ("cpu", "cuda"):
        tensors = [
            t.to(device) for t in (torch.arange(NUMBERS) * 160, scene.levels, scene.cells, values, values.round())
        ]
        on_device = None if labels is None else labels.to(device)
        found.append(walked_features(*tensors, labels=on_device, planes=planes, prefixes=True))
    for here, there in zip(*found, strict=True):
        assert torch.equal(here, there.cpu())


class Counted(TorchDispatchMode):
    """Counts the operators that are called."""

    calls = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.calls += 1
        return function(*args, **(kwargs or {}))


def calls_of_a_walk(count: int) -> int:
    """Operators of one walk over so many made-up splats on the GPU."""
    scene = made_up(count)
    values = (scene.values / torch.tensor(BASE_STEPS)).cuda()
    with Counted() as counted:
        walked_features(torch.arange(NUMBERS).cuda(), scene.levels.cuda(), scene.cells.cuda(), values, values.round())
    return counted.calls


def test_ten_times_the_splats_take_about_as_many_operators():
    assert 0 < calls_of_a_walk(200_000) < 2 * calls_of_a_walk(20_000)

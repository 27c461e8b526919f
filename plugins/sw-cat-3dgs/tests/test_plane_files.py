"""Compiled kernels of planes in files: the integers and the bytes of the torch and numpy operations they stand for."""

from types import SimpleNamespace

import numpy as np
import plane_lists
import pytest
import torch

from splatwizard_core.errors import BitstreamError
from sw_cat_3dgs import plane_streams, triplane
from sw_cat_3dgs.spatial_ar import SpatialAr
from sw_cat_3dgs.triplane import UNIT, Triplane
from sw_codecs.context import integer_mlp
from sw_codecs.entropy import exact_streams
from sw_codecs.exact_native import EXACT
from sw_codecs.testing import check_damage


@pytest.fixture
def kernels(monkeypatch):
    """Let the exact mode run with its compiled kernels or without: `kernels(False)`."""

    def use(compiled):
        if compiled:
            EXACT.load()
        without = SimpleNamespace(try_load=lambda: False, load_built=lambda: False)
        for module in (plane_streams, triplane, integer_mlp, exact_streams):
            monkeypatch.setattr(module, "EXACT", EXACT if compiled else without)

    return use


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def both(kernels, compute):
    """Results of `compute` with kernels and without."""
    found = []
    for compiled in (True, False):
        kernels(compiled)
        found.append(compute())
    return found


@pytest.mark.parametrize("sizes", [(1, 2), (5,), (3, 6, 9, 12)])
@pytest.mark.parametrize("channels", [1, 7, 8])
def test_planes_are_sampled(sizes, channels, kernels):
    drawn = [torch.randint(-(2**23), 2**23, (3, channels, r, r), generator=generator(r)) for r in sizes]
    places = torch.randint(0, UNIT + 1, (300, 3), generator=generator())
    places[:2] = torch.tensor([[0, UNIT, 0], [UNIT, UNIT, UNIT]])
    ours, expected = both(kernels, lambda: Triplane.exact_lookup(drawn)(places))
    assert torch.equal(ours, expected)


def spatial_models(count, scale=0.3):
    found = []
    for seed in range(count):
        made = SpatialAr(generator(seed))
        with torch.no_grad():
            for p in made.parameters():
                p.add_(torch.randn(p.shape, generator=generator(seed + 100)) * scale)
        found.append(made.exact())
    return found


CASES = {
    "one value": [(1, 1, 1)],
    "many channels": [(19, 5, 4), (19, 10, 8)],
    "narrow": [(9, 7, 1), (2, 1, 7)],
    "nothing beside something": [(0, 4, 4), (3, 4, 4), (3, 0, 5)],
    "more scales than the kernel takes": [(2, 3, 3)] * 5,
}


@pytest.mark.parametrize("case", CASES)
def test_planes_are_coded(case, kernels, monkeypatch):
    monkeypatch.setattr("sw_cat_3dgs.plane_streams.SMALLEST_STREAM", 45)
    shapes, models = CASES[case], spatial_models(3)
    r = np.random.default_rng(0)
    planes = [np.rint(r.laplace(0, 3, (3, *shape))).astype(np.int64) for shape in shapes]
    for plane in planes:
        plane.reshape(-1)[::40] += 70_000  # escapes
    coded = both(kernels, lambda: plane_lists.encode(planes, models))
    assert coded[0] == coded[1]
    for found in both(kernels, lambda: plane_lists.decode(coded[0], shapes, models)):
        assert all(np.array_equal(a, b) for a, b in zip(found, planes, strict=True))


@pytest.mark.parametrize("compiled", [True, False])
def test_damaged_planes_are_refused(compiled, kernels, monkeypatch):
    monkeypatch.setattr("sw_cat_3dgs.plane_streams.SMALLEST_STREAM", 12)
    models = spatial_models(1)
    plane = np.rint(np.random.default_rng(0).laplace(0, 40, (1, 3, 2, 3))).astype(np.int64)
    kernels(compiled)
    data = plane_lists.encode([plane], models)
    check_damage(data, lambda d: plane_lists.decode(d, [(3, 2, 3)], models)[0], plane, masks=(0x81,))


def test_streams_of_no_or_of_too_many_channels_are_refused():
    models, plane = spatial_models(1), np.ones((1, 4, 3, 3), np.int64)
    data = bytearray(plane_lists.encode([plane], models))
    place = len(exact_streams.prefix()) + 4
    assert data[place] == 4
    for channels in (0, 5):
        data[place] = channels
        with pytest.raises(BitstreamError):
            plane_lists.decode(bytes(data), [(4, 3, 3)], models)


def test_threads_change_no_plane(kernels):
    kernels(True)
    models = spatial_models(3)
    planes = [np.rint(np.random.default_rng(0).laplace(0, 3, (3, 12, 9, 9))).astype(np.int64)]
    kept, found = torch.get_num_threads(), set()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.add(plane_lists.encode(planes, models))
    finally:
        torch.set_num_threads(kept)
    assert len(found) == 1

"""spatial-ar: causal, decodes along wavefronts what it coded, learns, and costs what it estimates."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import plane_lists
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from sw_cat_3dgs.plane_coder import PlaneCoder, PlaneContext
from sw_cat_3dgs.plane_fields import Field
from sw_cat_3dgs.spatial_ar import NEIGHBORS, SpatialAr
from sw_codecs.entropy.exact_tables import exact_tables
from sw_codecs.exact_native import EXACT
from sw_codecs.testing import EntropyCase, check_context_model, check_damage, check_entropy_model


def network(seed=0, scale=1.0):
    made = SpatialAr(torch.Generator().manual_seed(seed))
    g = torch.Generator().manual_seed(seed + 100)
    with torch.no_grad():
        for p in made.parameters():
            p.add_(torch.randn(p.shape, generator=g) * 0.1 * scale)
    return made


def exact_networks(count=3):
    return [network(seed).exact() for seed in range(count)]


def drawn(*shape, seed=0, spread=2.0):
    return np.rint(np.random.default_rng(seed).laplace(0, spread, shape)).astype(np.int64)


def test_counts_are_the_papers():
    assert sum(p.numel() for p in SpatialAr().parameters()) == 1058
    assert len(NEIGHBORS) == 12


def test_a_value_changes_predictions_only_at_later_wavefronts():
    made, plane = network(), torch.from_numpy(drawn(6, 9)).float()
    before = torch.stack(made(plane))
    for r, c in ((0, 0), (2, 4), (3, 8), (5, 0)):
        changed = plane.clone()
        changed[r, c] += 3
        rows, columns = torch.nonzero((torch.stack(made(changed)) != before).any(dim=0), as_tuple=True)
        assert ((columns + 3 * rows) > c + 3 * r).all()
        if (r, c) == (2, 4):
            assert len(rows) == 12


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (2, 3), (3, 2), (7, 1), (7, 16), (16, 7), (16, 16)])
def test_planes_of_any_size_come_back(size):
    networks = exact_networks(2)
    planes = [drawn(2, 3, *size), drawn(2, 5, 2 * size[0], size[1], seed=1)]
    data = plane_lists.encode(planes, networks)
    found = plane_lists.decode(data, [(3, *size), (5, 2 * size[0], size[1])], networks)
    assert all(np.array_equal(a, b) for a, b in zip(found, planes, strict=True))


def test_nothing_comes_back_as_nothing():
    networks = exact_networks(1)
    assert plane_lists.decode(plane_lists.encode([], networks), [], networks) == []
    empty = np.zeros((1, 0, 4, 4), np.int64)
    assert plane_lists.decode(plane_lists.encode([empty], networks), [(0, 4, 4)], networks)[0].shape == empty.shape


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 3), st.integers(1, 5), st.integers(1, 5), st.integers(0, 99), st.sampled_from([0.1, 3.0, 1e5]))
def test_any_values_come_back(channels, height, width, seed, spread):
    networks, planes = exact_networks(1), [drawn(1, channels, height, width, seed=seed, spread=spread)]
    found = plane_lists.decode(plane_lists.encode(planes, networks), [(channels, height, width)], networks)
    assert np.array_equal(found[0], planes[0])


MEMORY = """
import sys, torch
from pathlib import Path
from sw_cat_3dgs.plane_coder import PlaneCoder, PlaneContext
from sw_cat_3dgs.spatial_ar import SpatialAr

def kilobytes(name):
    return int(Path("/proc/self/status").read_text().split(name)[1].split()[0])

torch.set_num_threads(3)
networks = [SpatialAr(torch.Generator().manual_seed(seed)).exact() for seed in range(3)]
one = PlaneCoder().decode(Path(sys.argv[2]).read_bytes(), PlaneContext(networks, [(1, 4, 4)]))  # the kernel is loaded
data = Path(sys.argv[1]).read_bytes()
before = kilobytes("VmRSS:")
PlaneCoder().decode(data, PlaneContext(networks, [(1, 400, 400)]))
print((kilobytes("VmHWM:") - before) * 1024)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no peak of a process to read")
def test_planes_of_one_channel_take_no_more_than_their_size_allows(tmp_path):
    if not EXACT.try_load():
        pytest.skip("no compiler: nothing is decoded side by side")
    networks = [SpatialAr(torch.Generator().manual_seed(seed)).exact() for seed in range(3)]
    for name, size in (("large", 400), ("small", 4)):
        (tmp_path / name).write_bytes(plane_lists.encode([np.zeros((3, 1, size, size), np.int64)], networks))
    command = [sys.executable, "-c", MEMORY, str(tmp_path / "large"), str(tmp_path / "small")]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(found.stdout) < 4 * (4 * 3 * 400 * 400)  # integers of 32 bits


def test_what_is_decoded_together_does_not_matter():
    """The integers of a network are those of each row alone."""
    networks, plane = exact_networks(), drawn(3, 4, 9, 9)
    field = Field(3, (4, 9, 9))
    field.fill(plane)
    rows = torch.from_numpy(field.neighbors(1, np.arange(81)))
    together = networks[1](rows)
    alone = [networks[1](row[None]) for row in rows[:40]]
    assert np.array_equal(together[0][:40], np.concatenate([mean for mean, _ in alone]))
    assert np.array_equal(together[1][:40], np.concatenate([level for _, level in alone]))


def test_levels_are_the_tables_nearest_to_the_scale():
    levels = exact_tables().scales
    made = SpatialAr()
    with torch.no_grad():
        made.layers[-1].weight.zero_()
    for level in (0, 1, 17, 40, 63):
        for shift in (0.95, 1.0, 1.05):
            with torch.no_grad():
                made.layers[-1].bias[1] = -2 * np.log(levels[level] * shift)
            _, found = made.exact()(torch.zeros(1, 12, dtype=torch.int64))
            assert found.tolist() == [level]
    for s, level in ((1e3, 0), (-1e3, 63)):
        with torch.no_grad():
            made.layers[-1].bias[1] = s
        assert made.exact()(torch.zeros(1, 12, dtype=torch.int64))[1].tolist() == [level]


def test_the_estimate_is_what_is_coded():
    made = [network(seed, scale=0.3) for seed in range(3)]
    networks = [each.exact() for each in made]
    planes = drawn(3, 10, 60, 60, spread=1.5)
    size = 8 * len(plane_lists.encode([planes], networks))
    tables = plane_lists.table_bits([planes], networks)
    floats = sum(float(made[k].bits(torch.from_numpy(planes[k]).float()).detach().sum()) for k in range(3))
    assert abs(size / tables - 1) < 2e-3
    assert abs(size / floats - 1) < 0.02


def test_damage_is_refused():
    networks, planes = exact_networks(1), [drawn(1, 2, 4, 5, spread=40.0)]
    data = plane_lists.encode(planes, networks)
    check_damage(data, lambda d: plane_lists.decode(d, [(2, 4, 5)], networks)[0], planes[0], masks=(0x01, 0x80))
    with pytest.raises(BitstreamError):
        plane_lists.decode(data, [(2, 4, 5)], [network(7, scale=5).exact()])


def test_weights_that_make_no_network_are_refused():
    for layer, name, value in ((4, "bias", math.inf), (2, "weight", 1e6)):
        made = network()
        with torch.no_grad():
            getattr(made.layers[layer], name).fill_(value)
        with pytest.raises(BitstreamError):
            made.exact()


def test_it_learns_a_smooth_ramp():
    i = torch.arange(32.0)
    slopes = ((1, 0.5), (0.5, -1), (-1, 0.2))
    plane = torch.stack([torch.round((i[:, None] * a + i * b) / 4) for a, b in slopes])
    _, counts = plane.unique(return_counts=True)
    share = counts / counts.sum()
    independent = -(share * share.log2()).sum().item() * plane.numel()
    made = SpatialAr(torch.Generator().manual_seed(0))
    optimizer = torch.optim.Adam(made.parameters(), lr=5e-3)
    for _ in range(200):
        optimizer.zero_grad()
        made.bits(plane).sum().backward()
        optimizer.step()
    assert made.bits(plane).sum().item() < 0.3 * independent


def test_gradients_pull_a_scale_back_into_the_range_of_the_coder():
    made = SpatialAr(torch.Generator().manual_seed(0))
    with torch.no_grad():
        made.layers[-1].weight.zero_()
        made.layers[-1].bias.copy_(torch.tensor([0.0, 20.0]))  # scale e^-10, values 1: too narrow by far
    made.bits(torch.ones(1, 3, 3)).sum().backward()
    assert made.layers[-1].bias.grad[1] > 0


def test_it_is_the_context_model_that_files_name():
    assert load_plugins().context_models.load("spatial-ar") is SpatialAr
    check_context_model(SpatialAr(), torch.zeros(2, 5, 6))


def planes_case(n):
    """About n integers that follow their models, three orientations at two scales."""
    networks, side = exact_networks(), 10
    channels = -(-n // (15 * side * side))
    planes = [drawn(3, channels, m * side, m * side, seed=m, spread=1.5) for m in (1, 2)]
    context = PlaneContext(networks, [plane.shape[1:] for plane in planes])
    return EntropyCase(context.join(planes), context, context, context)


def test_planes_in_a_file_keep_the_contract():
    assert load_plugins().entropy_models.load("wavefront") is PlaneCoder
    check_entropy_model(PlaneCoder, planes_case)

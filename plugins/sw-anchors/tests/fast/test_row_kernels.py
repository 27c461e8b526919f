"""The CUDA kernels for rows of anchors against torch operations."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from sw_anchors import rate_model
from sw_anchors.anchors import AnchorSelection
from sw_anchors.fast import rows as fast_rows
from sw_anchors.fast import sample_bits, statistics
from sw_anchors.fast.rows import add_rows, load_rows, noisy_rows, put_rows, take_rows
from sw_anchors.growth import accumulate_anchor_statistics
from sw_anchors.native import ANCHORS

ON_CUDA = ANCHORS.available(cuda=True)
pytestmark = [pytest.mark.cuda, pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))]


@pytest.fixture
def both_forms(monkeypatch):
    """Calls a function with the kernels, then without, and compares the tensors that it returns."""

    def compare(function, tolerance):
        forms = []
        for kernels in (True, False):
            if not kernels:
                monkeypatch.setattr(fast_rows, "fit_kernels", lambda *_: False)
            forms.append(function())
        for one, other in zip(*forms, strict=True):
            limit = tolerance * float(other.abs().max()) if other.numel() else 0.0
            torch.testing.assert_close(one, other, rtol=tolerance, atol=limit + 1e-9)

    return compare


def drawer(seed):
    generator = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.randn(shape, generator=generator).to("cuda")


@pytest.mark.parametrize(("n", "v"), [(1000, 333), (40, 1), (5, 0), (7, 7)])
def test_rows_are_taken_loaded_and_put_back(both_forms, n, v):
    draw = drawer(0)
    sources = [draw(n, 3), draw(n, 50), draw(n, 10, 3), draw(n, 1), draw(n, 70)[:, :33]]
    cells = torch.arange(n * 8, dtype=torch.int32, device="cuda").view(n, 2, 4)
    rows = torch.randperm(n, generator=torch.Generator().manual_seed(1))[:v].to("cuda")
    slopes = [draw(v, *source.shape[1:]) for source in sources]

    def compute():
        leaves = [source.detach().clone().requires_grad_() for source in sources]
        taken = take_rows(rows, *leaves)
        grads = torch.autograd.grad(taken, leaves, slopes)
        into = [torch.zeros(v + 3, 3, device="cuda"), torch.zeros(v + 3, 2, 4, dtype=torch.int32, device="cuda")]
        load_rows(rows, [sources[0], cells], into)
        put = put_rows(rows, [slopes[1], None, slopes[3]], n)
        assert put[1] is None
        return [*(each.detach() for each in taken), *grads, into[0], into[1].float(), put[0], put[2]]

    both_forms(compute, 0.0)


@pytest.mark.parametrize("features", [50, 33, 1])
@pytest.mark.parametrize(("capacity", "valid"), [(700, 650), (1, 1), (9, 0), (0, 0)])
@pytest.mark.parametrize("noisy", ["own steps", "one step", "none"])
@pytest.mark.parametrize("weighted", [True, False])
def test_noisy_rows_and_their_gradients_are_those_of_torch(both_forms, features, capacity, valid, noisy, weighted):
    draw, k = drawer(2), 10 if features > 1 else 1
    tensors = [draw(capacity, width) for width in (features, 6, 3 * k, k)]
    weights = draw(capacity, 1).abs() if weighted else None
    noise = draw(capacity * (features + 6 + 3 * k)) if noisy != "none" else None
    steps = {"own steps": draw(capacity, 3), "one step": draw(1, 3), "none": None}[noisy]
    count = torch.tensor(float(valid), device="cuda")
    slopes = [
        draw(capacity, features + 6 + 3 * k),
        draw(capacity, features + 4)[:, :-4],
        draw(capacity, 6),
        draw(capacity, k),
    ]

    def compute():
        leaves = [tensor.detach().clone().requires_grad_() for tensor in tensors]
        own = steps.detach().clone().requires_grad_(noisy == "own steps") if steps is not None else None
        values, groups, masks, kept = noisy_rows(leaves, weights, count, noise, own, 0.3)
        total = sum((a * b).sum() for a, b in zip((values, groups[0], groups[1], masks), slopes, strict=True))
        learning = [*leaves, *([own] if noisy == "own steps" else [])]
        return [
            values.detach(),
            *(g.detach() for g in groups),
            masks.detach(),
            kept,
            *torch.autograd.grad(total, learning),
        ]

    both_forms(compute, 1e-5)


@pytest.mark.parametrize(("count", "features", "k"), [(500, 50, 10), (1, 50, 10), (33, 7, 1), (0, 50, 10)])
def test_bits_of_a_sample_and_their_gradients_are_those_of_torch(count, features, k):
    draw, numbers = drawer(3), features + 6 + 3 * k
    x, mean = 3 * draw(count, numbers), 3 * draw(count, numbers)
    scale = draw(count, numbers)  # half of them below the floor
    steps, counted = draw(count, 3).abs() + 0.05, (draw(count) > -0.5).float()
    masks = (draw(count, k) > -0.5).float()

    found = []
    for form in (sample_bits, rate_model):
        leaves = [each.detach().clone().requires_grad_() for each in (x, mean, scale, steps, masks)]
        bits, by_group = form.bits_of(*leaves, counted, 1e-6, 1e-9)
        found.append([bits.detach(), by_group, *torch.autograd.grad(0.5 * bits, leaves)])
    for one, other in zip(*found, strict=True):
        limit = 1e-4 * float(other.abs().max()) if other.numel() else 0.0
        torch.testing.assert_close(one, other, rtol=1e-4, atol=limit + 1e-9)


def test_rows_are_added_where_they_are_named(both_forms):
    draw = drawer(4)
    rows = torch.tensor([3, 0, 7, 9, 9, 9], device="cuda")
    sources = [draw(6, 50), None, draw(6, 3), draw(6, 1)]
    before = [draw(10, 50), draw(10, 2), draw(10, 3), draw(10, 1)]

    def compute():
        into = [each.clone() for each in before]
        add_rows(rows, sources, into)
        return into

    both_forms(compute, 1e-6)
    expected = before[2].clone()
    for i, row in enumerate(rows.tolist()):
        expected[row] += sources[2][i]
    torch.testing.assert_close(compute()[2], expected)


@pytest.mark.parametrize(
    ("n", "v", "k", "share"), [(900, 300, 10, 0.3), (40, 40, 1, 1.0), (30, 5, 4, 0.0), (9, 0, 3, 0.0)]
)
def test_statistics_of_a_view_are_those_of_torch(monkeypatch, n, v, k, share):
    draw, generator = drawer(4), torch.Generator().manual_seed(5)
    rows = torch.randperm(n, generator=generator)[:v].to("cuda")
    drawn = torch.nonzero(torch.rand(v * k, generator=generator) < share).squeeze(1).to("cuda")
    selection = AnchorSelection(rows, draw(v, k), drawn)
    gradients, radii = draw(len(drawn), 2), torch.randint(0, 3, (len(drawn),), generator=generator).int().to("cuda")
    gradients[radii == 0] = float("nan")  # of what was not drawn
    found = []
    for kernels in (True, False):
        if not kernels:
            monkeypatch.setattr(statistics, "fits", lambda *_: False)
        shapes = {"opacity_accum": (n,), "anchor_denom": (n,), "offset_grad_accum": (n, k), "offset_denom": (n, k)}
        model = SimpleNamespace(**{name: torch.ones(shape, device="cuda") for name, shape in shapes.items()})
        if kernels:
            assert statistics.fits(model, selection, gradients, radii)
        for _ in range(2):
            accumulate_anchor_statistics(model, selection, gradients, radii)
        found.append(vars(model))
    for name, expected in found[1].items():
        torch.testing.assert_close(found[0][name], expected, rtol=1e-6, atol=1e-6, msg=name)


@pytest.mark.parametrize("count", [300, 0])
def test_rows_that_are_alike_are_copied_as_others(count):
    draw, n, v = drawer(6), 500, 320
    rows = torch.randperm(n, generator=torch.Generator().manual_seed(7))[:count].to("cuda")
    into = [torch.zeros(v, 30, device="cuda"), torch.zeros(v, 3, device="cuda")]
    load, put, add = (fast_rows.AlikeRows(way) for way in fast_rows.Way)
    shapes = [torch.Size((n, 10, 3)), torch.Size((n, 3)), torch.Size((n, 3))]
    for _ in range(3):
        sources = [draw(n, 10, 3), draw(n, 3)]
        load.load(rows, sources, into)
        assert all(torch.equal(x[:count], y.flatten(1)[rows]) for x, y in zip(into, sources, strict=True))
        torch.empty(n * 40, device="cuda").fill_(7)  # memory that is lent again is no zeros
        first, last, none = put.put(rows, [*into, None], shapes)
        assert none is None
        for found, source in ((first, into[0]), (last, into[1])):
            expected = torch.zeros(n, source.shape[1], device="cuda").index_copy_(0, rows, source[:count])
            assert torch.equal(found.flatten(1), expected)
        expected = [first.flatten(1).index_add(0, rows, into[0][:count]), last.index_add(0, rows, into[1][:count])]
        add.add(rows, [*into, None], [first, last, None])
        assert all(torch.equal(x.flatten(1), y) for x, y in zip((first, last), expected, strict=True))

"""Vector quantizer: nearest entries, k-means, EMA, seeds, bounded memory."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from splatwizard_core.errors import BitstreamError, ShapeError
from sw_codecs.quantizers.vector_quantizer import VectorQuantizer


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


def blobs(n=2000, k=8, seed=0):
    """Well separated clusters: rows, their cluster, the centres."""
    g = gen(seed)
    centres = torch.tensor([[i // 4 * 10.0, i % 4 * 10.0, i * 3.0] for i in range(k)])
    which = torch.randint(k, (n,), generator=g)
    return centres[which] + 0.1 * torch.randn(n, 3, generator=g), which, centres


def test_assignment_is_the_brute_force_nearest():
    x = torch.randn(500, 4, generator=gen(1), dtype=torch.float64)
    vq = VectorQuantizer(37, block=64)
    vq.fit(x, generator=gen(), iterations=2)
    assert torch.equal(vq.assign(x), torch.cdist(x, vq.codebook).argmin(1))


def test_kmeans_error_falls_and_ends_at_the_cluster_means():
    x, _, _ = blobs()
    vq = VectorQuantizer(60, block=300)
    errors = vq.fit(x, generator=gen(), iterations=12, spread=False)
    assert (errors.diff() <= 1e-6).all()
    assert errors[-1] < 0.8 * errors[0]
    assert vq.fit(x, generator=gen(), iterations=1) < 0.8 * errors[0]  # what the better start is for
    vq.fit(x, generator=gen(), iterations=60)
    index = vq.assign(x)
    for j in index.unique():
        torch.testing.assert_close(vq.codebook[j], x[index == j].mean(0), rtol=1e-4, atol=1e-4)


def test_the_same_seed_gives_the_same_codebook_whatever_the_block():
    x, _, _ = blobs()
    books = []
    for block, seed in ((1 << 14, 3), (100, 3), (1 << 14, 4)):
        vq = VectorQuantizer(16, block=block)
        vq.fit(x, generator=gen(seed))
        books.append(vq.codebook)
    torch.testing.assert_close(books[0], books[1])
    assert not torch.equal(books[0], books[2])


def test_weights_pull_entries():
    x = torch.tensor([[0.0], [1.0]])
    vq = VectorQuantizer(1)
    vq.fit(x, generator=gen(), weights=torch.tensor([3.0, 1.0]))
    assert float(vq.codebook) == pytest.approx(0.25)
    vq.fit(x, generator=gen(), weights=torch.tensor([0.0, 1.0]))
    assert float(vq.codebook) == 1.0


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_only_the_ratio_of_weights_matters(unit):
    x = torch.tensor([[0.0], [1.0], [50.0], [52.0]])
    vq = VectorQuantizer(2)
    vq.fit(x, generator=gen(), weights=unit * torch.tensor([3.0, 1.0, 1.0, 1.0]))
    assert vq.codebook.flatten().sort().values.tolist() == pytest.approx([0.25, 51.0])


def test_fewer_rows_than_entries_are_kept_exactly():
    x = torch.randn(5, 3, generator=gen())
    vq = VectorQuantizer(64)
    vq.fit(x, generator=gen())
    assert torch.allclose(vq.decode(*vq.encode(x)), x, atol=1e-6)


def test_one_ema_step_by_hand():
    vq = VectorQuantizer(2, decay=0.5, dead=0.0)
    vq.fit(torch.tensor([[0.0], [0.0], [10.0], [10.0]]), generator=gen())
    order = vq.codebook.squeeze(1).argsort()
    vq.update(torch.tensor([[2.0], [2.0], [14.0]]), generator=gen())
    # Counts: (2, 2) and (2, 1) -> (2, 1.5); sums: (0, 20) and (4, 14) -> (2, 17).
    assert vq.codebook.squeeze(1)[order].tolist() == pytest.approx([1.0, 17 / 1.5], rel=1e-4)


def test_dead_entries_are_seeded_anew_from_the_data():
    vq = VectorQuantizer(2, decay=0.0, dead=0.5)
    vq.fit(torch.tensor([[0.0], [100.0]]), generator=gen())
    vq.update(torch.tensor([[1.0], [1.5]]), generator=gen())
    assert vq.codebook.max() <= 1.5


def test_gradient_passes_straight_through_and_commitment_pulls():
    x, _, _ = blobs(200)
    vq = VectorQuantizer(8, commitment=0.5)
    vq.fit(x, generator=gen())
    x = x.requires_grad_()
    (vq.forward(x) * 2).sum().backward()
    assert (x.grad == 2).all()
    x.grad = None
    vq.commitment_loss(x).backward()
    nearest = vq.codebook[vq.assign(x)]
    torch.testing.assert_close(x.grad, 2 * 0.5 * (x.detach() - nearest) / x.numel())


def test_a_codebook_can_be_trained_by_gradient():
    x, _, _ = blobs(300)
    vq = VectorQuantizer(8)
    vq.fit(x, generator=gen(), iterations=0)
    vq.codebook = torch.nn.Parameter(vq.codebook)
    optimizer = torch.optim.Adam([vq.codebook], lr=0.1)
    losses = []
    for _ in range(40):
        optimizer.zero_grad()
        loss = vq.codebook_loss(x.requires_grad_())
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    assert x.grad is None


@pytest.mark.parametrize("half", [False, True])
def test_decoded_rows_are_the_nearest_stored_entries(half):
    x, _, _ = blobs(300)
    vq = VectorQuantizer(20, half=half)
    vq.fit(x, generator=gen())
    symbols, side = vq.encode(x)
    assert side["codebook"].dtype == (np.float16 if half else np.float32)
    decoded = VectorQuantizer.decode(symbols, side)
    book = torch.from_numpy(side["codebook"].astype(np.float32))
    assert torch.equal(decoded, book[torch.cdist(x, book, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)])
    assert torch.equal(vq.encode(decoded)[0], symbols)


def test_hostile_indices_and_codebooks_are_refused():
    symbols, book = torch.tensor([0, 1]), np.zeros((2, 3), np.float32)
    for index, side in (
        (symbols + 1, {"codebook": book}), (symbols - 1, {"codebook": book}), (symbols, {}),
        (symbols, {"codebook": book[0]}), (symbols, {"codebook": book * np.nan}),
        (symbols, {"codebook": book.astype(int)}),
    ):  # fmt: skip
        with pytest.raises(BitstreamError):
            VectorQuantizer.decode(index, side)


def test_wrong_use_is_refused():
    with pytest.raises(RuntimeError, match="fit first"):
        VectorQuantizer(4).assign(torch.zeros(1, 2))
    vq = VectorQuantizer(4)
    with pytest.raises(ShapeError):
        vq.fit(torch.zeros(0, 2), generator=gen())
    vq.fit(torch.zeros(3, 2), generator=gen())
    with pytest.raises(ShapeError):
        vq.assign(torch.zeros(3, 4))
    with pytest.raises(ValueError, match="finite"):
        vq.encode(torch.tensor([[float("nan"), 0.0]]))
    with pytest.raises(ValueError, match="weights"):
        vq.fit(torch.zeros(3, 2), generator=gen(), weights=torch.tensor([1.0, -1.0, 1.0]))


MEMORY = """
import resource, torch
from sw_codecs.quantizers.vector_quantizer import VectorQuantizer
torch.set_num_threads(1)
x = torch.rand(30_000, 3, generator=torch.Generator().manual_seed(0))
vq = VectorQuantizer(4096, block=1 << 12)
vq.codebook = x[:4096]
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
vq.assign(x)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


def test_the_search_never_holds_the_whole_distance_matrix():
    # N x K float32 is 490 MB; a block of it is 67 MB.
    found = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    assert int(found.stdout) < 250e6

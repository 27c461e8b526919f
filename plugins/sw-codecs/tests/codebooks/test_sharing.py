"""Sensitive vectors keep an entry of their own, the others share: by the published loop, weighted by sensitivity."""

import pytest
import torch

from splatwizard_core.api import ShapeError
from sw_codecs.codebooks import sharing
from sw_codecs.codebooks.sharing import share_vectors


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def share(x, sensitivity, **settings):
    return share_vectors(
        torch.as_tensor(x, dtype=torch.float32),
        torch.as_tensor(sensitivity, dtype=torch.float32),
        **{"threshold": 0.5, "size": 8, "generator": generator(), **settings},
    )


def test_a_threshold_of_zero_keeps_everything_that_matters_as_it_is():
    x = torch.randn(50, 7, generator=generator())
    found = share(x, torch.rand(50, generator=generator()) + 1e-6, threshold=0.0)
    assert torch.equal(found.entries[found.index], x)
    assert found.own.tolist() == list(range(50))


def test_an_infinite_threshold_keeps_nothing():
    x = torch.randn(50, 7, generator=generator())
    found = share(x, torch.ones(50), threshold=float("inf"))
    assert len(found.own) == 0
    assert len(found.entries) <= 8


def test_entries_that_are_kept_follow_the_shared_ones_in_their_order():
    x = torch.arange(12.0).reshape(6, 2)
    found = share(x, [0.1, 0.9, 0.2, 0.8, 0.3, 0.7])
    assert found.own.tolist() == [1, 3, 5]
    assert found.index.tolist() == [0, 3, 1, 4, 2, 5]
    assert torch.equal(found.entries, x[[0, 2, 4, 1, 3, 5]])


def test_no_more_distinct_vectors_than_entries_stand_for_themselves():
    points = torch.randn(5, 3, generator=generator()) * 10
    x = points[torch.randint(5, (200,), generator=generator())]
    for training in ("batch-mean", "kmeans"):
        found = share(x, torch.zeros(200), training=training)
        assert torch.equal(found.entries[found.index], x)
        assert len(found.entries) == 5


def test_of_many_vectors_the_distinct_ones_are_not_counted(monkeypatch):
    monkeypatch.setattr(sharing, "COUNTED", 199)
    points = torch.randn(5, 3, generator=generator()) * 10
    x = points[torch.randint(5, (200,), generator=generator())]
    found = share(x, torch.zeros(200), training="kmeans", iterations=3)
    assert torch.allclose(found.entries[found.index], x, atol=1e-4)
    assert len(found.entries) == 5


def test_one_entry_goes_to_the_mean_that_is_weighted_by_sensitivity():
    """x = 0 with weight 1 and x = 1 with weight 3: 0.75."""
    x, sensitivity = [[0.0], [1.0]] * 500, [0.1, 0.3] * 500
    for training in ("batch-mean", "kmeans"):
        found = share(x, sensitivity, size=1, training=training, iterations=60, batch=1000)
        spread = 0.02 if training == "batch-mean" else 1e-6  # a batch draws with replacement
        assert float(found.entries[0, 0]) == pytest.approx(0.75, abs=spread)


@pytest.mark.parametrize("training", ["batch-mean", "ema", "kmeans"])
def test_clusters_are_found_and_unused_entries_left_out(training):
    g = generator(3)
    centres = torch.rand(4, 3, generator=g) * 10
    x = centres[torch.randint(4, (400,), generator=g)] + 0.01 * torch.randn(400, 3, generator=g)
    found = share(
        x, torch.rand(400, generator=g) * 0.4, size=64, training=training, iterations=60, batch=256, generator=g
    )
    assert len(torch.unique(found.index)) == len(found.entries) <= 64
    assert float((found.entries[found.index] - x).norm(dim=1).max()) < 1.0


def test_a_projection_holds_for_every_shared_entry():
    x = torch.rand(300, 4, generator=generator())
    found = share(
        x, torch.zeros(300), iterations=5, batch=100, project=lambda entries: entries / entries.sum(1, keepdim=True)
    )
    assert torch.allclose(found.entries.sum(1), torch.ones(len(found.entries)))


def test_vectors_that_no_view_shows_have_no_weight():
    x = torch.tensor([[0.0], [0.1], [5.0], [9.0]])
    found = share(x, [0.1, 0.1, -torch.inf, -torch.inf], size=1, training="kmeans", iterations=5)
    assert float(found.entries[0, 0]) == pytest.approx(0.05)


def test_nothing_gives_nothing_and_wrong_input_is_told():
    empty = share(torch.zeros(0, 3), torch.zeros(0))
    assert (len(empty.index), tuple(empty.entries.shape)) == (0, (0, 3))
    with pytest.raises(ShapeError, match="sensitivity"):
        share(torch.zeros(3, 2), torch.zeros(2))
    with pytest.raises(ValueError, match="not a number"):
        share(torch.zeros(3, 2), [0.0, float("nan"), 1.0])

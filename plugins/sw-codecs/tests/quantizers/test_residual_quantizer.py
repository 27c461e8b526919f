"""Residual vector quantizer: error by stage, gradients, training of the codebooks, hostile input."""

import numpy as np
import pytest
import torch

from splatwizard_core.errors import BitstreamError, ShapeError
from sw_codecs.quantizers.residual_quantizer import ResidualVectorQuantizer


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


def clusters(n, k, d=4, noise=0.1, seed=0):
    g = gen(seed)
    return torch.randn(k, d, generator=g)[torch.randint(k, (n,), generator=g)] + noise * torch.randn(n, d, generator=g)


def test_each_stage_leaves_less():
    x = torch.randn(2000, 3, generator=gen())
    for iterations in (1, 5):
        q = ResidualVectorQuantizer(16, 6)
        errors = q.fit(x, generator=gen(), iterations=iterations)
        assert errors.shape == (6,)
        assert (errors.diff() < 0).all()
        assert float((q.forward(x) - x).square().sum(1).mean()) == pytest.approx(float(errors[-1]), rel=1e-4)
    assert errors[-1] < 0.01 * x.square().sum(1).mean()


def test_rows_of_sixty_four_values_need_one_stage():
    x = clusters(1000, 64, noise=0.0)
    errors = ResidualVectorQuantizer(64, 2).fit(x, generator=gen(), iterations=10)
    assert errors[0] < 1e-8


def test_residual_symbols_by_hand():
    q = ResidualVectorQuantizer(2, 3, dim=1)
    q.codebooks.data = torch.tensor([[[0.0], [8.0]], [[-2.0], [2.0]], [[-0.5], [0.5]]])
    x = torch.tensor([[9.6], [-1.0]])
    symbols, side = q.encode(x)
    assert symbols.tolist() == [[1, 1, 0], [0, 0, 1]]
    assert ResidualVectorQuantizer.decode(symbols, side).tolist() == [[9.5], [-1.5]]
    assert torch.equal(q.forward(x), q.decode(symbols, side))


def test_the_residual_gradient_passes_once():
    x = clusters(50, 4).requires_grad_()
    q = ResidualVectorQuantizer(8, 6)
    q.fit(x, generator=gen(), iterations=2)
    (3 * q.forward(x)).sum().backward()
    assert (x.grad == 3).all()
    assert q.codebooks.grad is None


def test_the_codebook_loss_is_that_of_each_stage_and_trains_the_codebooks_alone():
    x = clusters(400, 20).requires_grad_()
    q = ResidualVectorQuantizer(8, 3)
    q.fit(x, generator=gen(), iterations=1, spread=False)
    loss = q.codebook_loss(x)
    residual, expected = x.detach(), 0.0
    for stage, index in enumerate(q.assign(x).T):
        residual = residual - q.codebooks.detach()[stage][index]
        expected += float(residual.square().mean())
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-5)
    loss.backward()
    assert x.grad is None
    found, same = q.forward_with_loss(x)
    assert torch.equal(found, q.forward(x))
    assert torch.equal(same, loss)
    found.sum().backward()
    assert (x.grad == 1).all()
    x = x.detach()
    before = float((q.forward(x) - x).square().mean())
    optimizer = torch.optim.Adam(q.parameters(), lr=1e-2)
    for _ in range(60):
        optimizer.zero_grad()
        q.codebook_loss(x).backward()
        optimizer.step()
    assert float((q.forward(x) - x).square().mean()) < before


def test_an_optimizer_keeps_the_codebooks_of_a_second_fit():
    x = clusters(200, 8)
    q = ResidualVectorQuantizer(8, 2, dim=4)
    held = q.codebooks
    q.fit(x, generator=gen())
    assert q.codebooks is held
    assert held.abs().sum() > 0


@pytest.mark.parametrize("half", [False, True])
def test_decode_is_forward_and_state_goes_through_a_checkpoint(half):
    x = clusters(300, 12)
    q = ResidualVectorQuantizer(8, 3, half=half)
    with pytest.raises(RuntimeError, match="fit first"):
        q.assign(x)
    q.fit(x, generator=gen())
    symbols, side = q.encode(x)
    decoded = q.decode(symbols, side)
    assert decoded.dtype == torch.float32
    if q.is_half:
        assert next(iter(side.values())).dtype == np.float16
    else:
        assert torch.equal(decoded, q.forward(x))
    again = ResidualVectorQuantizer(8, 3, half=half)
    again.load_state_dict(q.state_dict())
    assert torch.equal(again.forward(x), q.forward(x))
    assert torch.equal(again.encode(x)[0], symbols)
    assert again.forward(x[:0]).shape == (0, 4)
    assert q.decode(symbols[:0], side).shape == (0, 4)
    with pytest.raises(ShapeError):
        q.encode(x[:, :3])
    with pytest.raises(ValueError, match="finite"):
        q.encode(x * torch.nan)


def test_weights_count():
    x = torch.tensor([[0.0], [1.0]])
    q = ResidualVectorQuantizer(1, 1)
    q.fit(x, generator=gen(), weights=torch.tensor([3.0, 1.0]))
    assert q.forward(x).flatten().tolist() == pytest.approx([0.25, 0.25])
    for weights in (torch.tensor([1.0, -1.0]), torch.zeros(2), torch.ones(3)):
        with pytest.raises(ValueError, match="weights"):
            q.fit(x, generator=gen(), weights=weights)
    with pytest.raises(ShapeError):
        q.fit(x[:0], generator=gen())


def test_hostile_codebooks_and_symbols_are_refused():
    books = np.zeros((2, 4, 3), np.float32)
    symbols = torch.tensor([[0, 3], [1, 2]])
    decode = ResidualVectorQuantizer.decode
    assert decode(symbols, {"codebooks": books}).shape == (2, 3)
    for bad, side in (
        (symbols + 1, books), (symbols - 1, books), (symbols[:, :1], books), (symbols[:, 0], books),
        (symbols.float(), books), (symbols, books[0]), (symbols, books[:0]), (symbols, books[:, :0]), (symbols, None),
        (symbols, books * np.nan), (symbols, books.astype(int)), (symbols, np.full((2, 4, 3), 1e300)),
        (symbols, np.full((2, 4, 3), 3e38, np.float32)), (symbols[:, :0], books[:0]),
    ):  # fmt: skip
        with pytest.raises(BitstreamError):
            decode(bad, {"codebooks": side})


def test_wrong_use_is_refused():
    for wrong in ({"size": 0}, {"stages": 0}, {"block": 0}):
        with pytest.raises(ValueError, match="size"):
            ResidualVectorQuantizer(**wrong)


def test_the_gradient_of_the_codebooks_has_the_same_bits_with_several_threads(several_threads):
    x = torch.randn(20_000, 3, generator=gen())
    q = ResidualVectorQuantizer(16, 2)
    q.fit(x[:2000], generator=gen(), iterations=1, spread=False)
    found = [torch.autograd.grad(q.codebook_loss(x), q.codebooks)[0] for _ in range(3)]
    assert all(torch.equal(each, found[0]) for each in found)


@pytest.fixture
def several_threads():
    """As on a machine whose cores nobody else wants."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)

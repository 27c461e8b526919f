"""Rows that a camera sees: values and gradients are those of `index_select` and `index_copy`."""

import pytest
import torch
from sw_compact3dgs.seen_rows import SeenRows

CASES = {"some": [1, 0, 0, 1, 1, 0], "first not": [0, 1, 1, 0, 1, 1], "all": [1] * 6, "none": [0] * 6}


@pytest.mark.parametrize("seen", CASES.values(), ids=CASES)
def test_rows_are_taken_and_put_back(seen: list[int]) -> None:
    mask = torch.tensor(seen).bool()
    values = torch.arange(18.0).view(6, 3).add(1).requires_grad_()
    slopes = torch.arange(18.0).view(6, 3).sub(7)
    index = torch.nonzero(mask).squeeze(1)
    rows = SeenRows(mask)

    taken, expected = rows.take(values), values.index_select(0, index)
    put, copied = rows.put(taken.square()), torch.zeros(6, 3).index_copy(0, index, expected.square())

    assert torch.equal(taken, expected)
    assert torch.equal(put, copied)
    (found,), (wanted,) = (torch.autograd.grad((each * slopes).sum(), values) for each in (put, copied))
    assert torch.equal(found, wanted)

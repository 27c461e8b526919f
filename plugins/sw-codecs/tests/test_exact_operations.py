"""Refusals of the operations of the exact mode, before a kernel reads or writes beyond a tensor."""

import numpy as np
import pytest
import torch

from sw_codecs.entropy.exact_streams import share_tables
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations

pytestmark = pytest.mark.skipif(EXACT.available() is not None, reason=str(EXACT.available()))


def integers(*shape, dtype=torch.int64):
    return torch.zeros(shape, dtype=dtype)


def streams(count=10, sizes=((0, 4, 0),), data=4, centres=None):
    return exact_operations.decode_streams(
        share_tables("gaussian"), torch.zeros(data, dtype=torch.uint8), torch.tensor(sizes),
        integers(count if centres is None else centres, dtype=torch.int32), integers(count, dtype=torch.int16),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"data": 3}, "streams end behind the data"),
        ({"data": 5}, "data behind the last stream"),
        ({"sizes": ((0, -4, 8),)}, "streams end behind the data"),
        ({"sizes": ((0, 4, 2**63 - 1),)}, "streams end behind the data"),
        ({"sizes": ((0, 2, 0), (0, 2, 0))}, "10 symbols are not 2 streams"),
        ({"centres": 11}, "number must be a contiguous int16"),
    ],
)
def test_streams_that_do_not_fit_their_data(change, said):
    with pytest.raises(RuntimeError, match=said):
        streams(**change)


def test_rows_that_differ_in_shape_or_have_gaps():
    mean, scale, step, thresholds = integers(4, 3), integers(4, 3), integers(4, 1), integers(63)
    with pytest.raises(RuntimeError, match="scale must be"):
        exact_operations.lattice(mean, scale[:, :2], step, None, thresholds)
    with pytest.raises(RuntimeError, match="in one piece"):
        exact_operations.lattice(mean, integers(4, 6)[:, ::2], step, None, thresholds)
    with pytest.raises(RuntimeError, match="thresholds must be"):
        exact_operations.lattice(mean, scale, step, None, thresholds[:62])
    with pytest.raises(RuntimeError, match="present must be"):
        exact_operations.lattice(mean, scale, step, torch.ones(4, 2, dtype=torch.bool), thresholds)
    with pytest.raises(RuntimeError, match="5 numbers are present, not 4"):
        exact_operations.put_values(
            integers(4, dtype=torch.int32), torch.ones(5, 1, dtype=torch.bool), torch.ones(5, 1, dtype=torch.float64),
            torch.zeros(5, 1),
        )  # fmt: skip


@pytest.mark.parametrize(
    ("part", "said"), [((1, 0, 0, 2), "outside"), ((0, 3, 0, 2), "outside"), ((0, 0, 1, 2), "outside")]
)
def test_streams_outside_of_planes(part, said):
    planes, weights = [integers(3, 2, 4, 4, dtype=torch.int32)], torch.zeros(3, 1058, dtype=torch.float64)
    sizes = torch.tensor([[0, 0, 0]])
    with pytest.raises(RuntimeError, match=said):
        exact_operations.decode_planes(
            share_tables("laplace"), torch.zeros(0, dtype=torch.uint8), sizes, planes, torch.tensor([part]), weights
        )


def test_layers_that_leave_the_weights():
    inputs, found = [integers(5, 3)], integers(5, 2)
    for widths, numbers, said in (
        ((3, 2), 7, "layer 0 leaves the weights"),
        ((3, 2), 9, "more weights than layers take"),
        ((4, 2), 10, "do not fit 3 inputs"),
        ((3, 1), 4, "has 1 outputs"),
        ((3, -1, 2), 8, "layer 0 leaves the weights"),
    ):
        weights = torch.zeros(numbers, dtype=torch.float64)
        with pytest.raises(RuntimeError, match=said):
            exact_operations.network(inputs, weights, torch.tensor(widths), 0, found)


def test_mixtures_out_of_range():
    tables = [torch.zeros(9, dtype=torch.float64), torch.zeros(512, dtype=torch.float64)]
    tables += [integers(512, dtype=torch.int32)] * 2
    for change in ({0: [0, 2]}, {1: [4, 0]}, {3: [[0, 512], [0, 0]]}):
        rows = [np.array([0, 1]), np.array([4, 4]), np.zeros((2, 2)), np.zeros((2, 2)), np.array([9, 9])]
        for i, values in change.items():
            rows[i] = np.array(values)
        tensors = [torch.from_numpy(row.astype(np.int16 if i == 3 else np.int32)) for i, row in enumerate(rows)]
        with pytest.raises(RuntimeError, match="is out of range"):
            exact_operations.decode_mixtures(tables, tensors, torch.zeros(8, dtype=torch.uint8))

"""The rate of the masks: one object for the loss and the file, whose estimate is the size of the rows."""

import pytest
import torch
from compact_models import PLUGINS, make, written
from sw_compact3dgs.mask_rate import MaskRate

ROWS = ("positions", "opacities", "scales/indices", "rotations/indices")


@pytest.fixture
def rate():
    return MaskRate(PLUGINS.quantizers.load("ste-mask")(0.01), size=64, stages=6)


def test_a_row_has_the_bits_of_its_numbers(rate):
    assert rate.row_bits == 3 * 16 + 16 + 2 * 6 * 6


def test_the_loss_is_the_mean_of_the_sigmoids(rate):
    logits = torch.tensor([0.0, 2.0, -7.0], requires_grad=True)
    forecast = rate.forecast(logits)
    torch.testing.assert_close(rate.share(forecast), torch.sigmoid(logits).mean())
    torch.testing.assert_close(rate.rate(forecast), torch.sigmoid(logits).sum() * rate.row_bits)
    (slope,) = torch.autograd.grad(rate.rate(forecast), logits)
    torch.testing.assert_close(slope, rate.row_bits * (forecast * (1 - forecast)).detach())


def test_the_file_has_the_rows_above_the_threshold(rate):
    threshold = torch.logit(torch.tensor(0.01))
    assert rate.exact(threshold + torch.tensor([-0.1, 0.1, 3.0])).tolist() == [False, True, True]


@pytest.mark.parametrize("off", [0, 700])
def test_estimated_and_real_bytes_agree(off):
    model = make(2000, off=off)
    estimated = float(model.rate.rate(model.rate.exact(model.mask_logits).float()).detach()) / 8
    plain, processed = (written(model, codec__settings__pp=pp).sections for pp in (False, True))
    assert sum(plain[name] for name in ROWS) == pytest.approx(estimated, rel=0.02)
    assert sum(processed[name] for name in ROWS) < estimated

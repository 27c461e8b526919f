import numpy as np
import pytest
import torch

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader
from sw_codecs.context.integer_mlp import IntegerMlp
from sw_wisp.eight_bits import EightBitLayer, pack_layers, unpack_layers


def test_one_large_weight_does_not_cost_the_rest_of_its_row():
    weight = np.random.default_rng(0).normal(0, 0.2, (1, 64))
    weight[0, 0] = 1.01
    layer = EightBitLayer.nearest(weight, None)
    assert layer.weights[0, 0] == 127
    assert layer.exponents[0] == -7


def test_layers_return_and_are_exact_as_integers():
    rng = np.random.default_rng(0)
    layer = EightBitLayer.nearest(rng.normal(0, 0.2, (14, 48)), rng.normal(0, 30, 14), lowest=-12)
    (again,) = unpack_layers(ByteReader(pack_layers([layer])), [layer.shape])
    for a, b in zip(layer.floats(), again.floats(), strict=True):
        assert np.array_equal(a, b)
    weight, bias = layer.floats()
    rows = np.vstack([np.zeros(48, np.int64), np.eye(48, dtype=np.int64) * 4096])  # 0, and 1 in one place each
    found = IntegerMlp([(weight, bias)])(torch.from_numpy(rows)).numpy()
    assert np.array_equal(found[0], np.round(bias * 4096))
    assert np.array_equal(found[1:], np.round((weight.T + bias) * 4096))


def test_the_error_is_half_a_unit_of_the_row():
    rng = np.random.default_rng(1)
    weight, bias = rng.normal(0, 0.1, (20, 30)), rng.normal(0, 5, 20)
    layer = EightBitLayer.nearest(weight, bias)
    assert np.abs(layer.floats()[1] - bias).max() <= 0.5 * 2.0**layer.bias_exponent
    assert np.sqrt(((layer.floats()[0] - weight) ** 2).mean()) < 0.01 * np.sqrt((weight**2).mean())


def test_no_biases_are_zeros_and_no_bytes():
    layer = EightBitLayer.nearest(np.ones((3, 2)), None)
    assert layer.shape == (3, 2, 0)
    assert layer.floats()[1].tolist() == [0, 0, 0]


def test_senseless_bytes_are_refused():
    layer = EightBitLayer.nearest(np.ones((3, 2)), np.ones(3))
    data = pack_layers([layer])
    for cut in range(len(data)):
        with pytest.raises(BitstreamError):
            unpack_layers(ByteReader(data[:cut]), [layer.shape])
    with pytest.raises(BitstreamError):
        unpack_layers(ByteReader(data), [(4096, 4096, 1)])
    with pytest.raises(ValueError, match="finite"):
        EightBitLayer.nearest(np.array([[np.nan]]), None)

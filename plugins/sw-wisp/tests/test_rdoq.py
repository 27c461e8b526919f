from dataclasses import replace

import numpy as np
import pytest
from wisp_scenes import made_up

from splatwizard_core.api import ContainerReader, ContainerWriter
from sw_wisp import file
from sw_wisp.nested import UNIT, index_bits
from sw_wisp.numbers import BASE_STEPS, NUMBERS
from sw_wisp.packets import Prediction
from sw_wisp.rdoq import RateDistortion

STEPS = np.array(BASE_STEPS)


def written(scene, choice=file.nearest) -> tuple[bytes, file.Encoded]:
    writer = ContainerWriter("wisp", 1)
    encoded = file.encode(scene, writer, choice)
    return writer.to_bytes(), encoded


def squared_error(scene, encoded, weights) -> float:
    off = encoded.decoded.values().double().numpy() - scene.values.numpy()[encoded.rows]
    return float((weights[encoded.rows] * off**2).sum())


def test_free_bits_leave_the_nearest_and_worthless_numbers_become_zero():
    scene = made_up(700)
    data, _ = written(scene)
    weights = np.ones((700, NUMBERS))
    assert written(scene, RateDistortion(weights, 0.0, STEPS))[0] == data
    _, encoded = written(scene, RateDistortion(0 * weights, 1.0, STEPS))
    assert not encoded.decoded.state.index.any()


@pytest.mark.parametrize(("subsets", "planes"), [(1, 0), (3, 1)])
def test_loss_and_bits_together_fall(subsets, planes):
    scene = made_up(5000, spread=1.0, subsets=subsets, planes=planes)
    scene = replace(scene, values=scene.values / 8)  # deviations of half a step
    weights = np.exp(np.random.default_rng(0).normal(0, 1.2, (5000, NUMBERS))) / STEPS**2
    price = 0.1
    plain, before = written(scene)
    chosen, after = written(scene, RateDistortion(weights, price, STEPS))
    assert file.decode(ContainerReader(chosen)).digest() == after.decoded.digest()
    assert len(chosen) < 0.95 * len(plain)
    saved = price * 8 * (len(plain) - len(chosen))
    assert squared_error(scene, after, weights) - squared_error(scene, before, weights) < saved


def test_each_choice_is_the_best_of_the_three():
    rng = np.random.default_rng(1)
    known = Prediction(*(np.full((400, 3), n) for n in (4096, 25 * UNIT, 3000)))
    wanted, weights = rng.normal(4096, 20_000, (400, 3)), rng.random((400, NUMBERS)) * 400
    found = RateDistortion(weights, 0.3, STEPS)(wanted, np.arange(400), slice(7, 10), known)

    def cost(k):
        off = (4096 + 3000 * k - wanted) * STEPS[7:10] / UNIT
        return weights[:, 7:10] * off**2 + 0.3 * index_bits(np.full(k.shape, 25), k)

    nearest = file.nearest(wanted, np.arange(400), slice(7, 10), known)
    for other in (nearest, nearest - np.sign(nearest), 0 * nearest):
        assert (cost(found) <= cost(other) + 1e-12).all()
    assert (found != nearest).any()

"""HAC to a size: its estimate, its loss, and its file."""

from types import SimpleNamespace

import pytest
import torch
from hac_models import decoded, encoded, make, method
from sw_compress.lambda_control import LeadToSize, estimated_bytes

from splatwizard_core.api import ContainerReader, TaskLog
from sw_hac import codec


@pytest.fixture(scope="module")
def model():
    return make(n=3000)


def test_the_estimate_is_the_size_of_the_sections(model):
    sections = ContainerReader(encoded(model)).sections
    size = sum(sections[name] for name in (*codec.SECTIONS.values(), "grids"))
    assert estimated_bytes(model) == pytest.approx(size, rel=0.03)


@pytest.mark.parametrize("share", [0.9, 1.08])
def test_a_file_of_another_size_decodes(model, share: float):
    model, size = make(n=3000), int(share * len(encoded(model)))
    task, config, scene = (
        LeadToSize(str(size), "hac", 10, 20),
        method(codec="hac").config,
        SimpleNamespace(origin=(0, 0, 0)),
    )
    task(model, config, None, scene, None, 20, TaskLog())
    data = encoded(model)
    assert 0.97 * size - 1_000 < len(data) <= size
    found = decoded(data)
    assert found.num_rows == int(model.kept().sum())
    assert (found.features.std() / model.features[model.kept()].std() - 1).abs() < 0.05


def test_the_factor_is_on_lambda():
    model = make(n=20)
    stage = method(size="1MB").stages()[0]
    one = torch.tensor(1.0)
    result = SimpleNamespace(extras={"rate": SimpleNamespace(bits=one, own_bits=one)})
    plain = {name: weight for name, (weight, _) in stage.extra_loss(model, result, 1).items()}
    stage.leading.state["factor"] = 3.0
    scaled = {name: weight for name, (weight, _) in stage.extra_loss(model, result, 1).items()}
    assert scaled == pytest.approx({name: 3 * weight for name, weight in plain.items()})


def test_the_state_is_in_checkpoints():
    model, other = make(n=10), make(n=10)
    assert "led" not in model.state_dict_extra()
    model.led = {"steps": [1.0, 1.1, 1.1]}
    other.load_state_dict_extra(model.state_dict_extra())
    assert other.led == model.led


def test_the_plan_has_the_control_where_there_is_a_size():
    from test_schedule_hac import steps_of

    found = steps_of(method(size="5MB").stages()[0], "lead lambda to the size")
    assert found[:2] == [1, 11_001]
    assert found[-2] < 25_500
    assert found[-1] == 30_000
    assert steps_of(method().stages()[0], "lead lambda to the size") == []

"""Steps in one and steps in parts give the same numbers, and whoever asks for something of their own gets parts."""

import pytest
import torch
from sw_gaussians.config import GaussianTraining
from sw_gaussians.fast.whole_step import is_plain
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.wrapped_stage import WrappedStage

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import Streams
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.stage import StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import Trainer

STEPS, SIZE = 14, 32
DENSE = {"settings": {"start": 4, "stop": 9, "interval": 4, "grad_threshold": 1e-7}}


class Parts(ThreeDGSStage):
    """The same, step by step in parts."""


def trained(kind, device="cpu", control=None, fuses=False, **more):
    """A trainer after some steps of 40 Gaussians, and the steps that were taken whole."""
    generator = torch.Generator().manual_seed(3)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    shapes = {"sh_dc": (40, 1, 3), "sh_rest": (40, 8, 3), "opacity_logits": (40,), "log_scales": (40, 3)}
    raw = {"means": rand(40, 3) * 2 - 1, "quats": rand(40, 4), **{name: rand(*s) - 0.5 for name, s in shapes.items()}}
    raw["log_scales"] -= 2
    model = GaussianModel.from_tensors(**raw, active_sh_degree=0).to(device)
    pixels = (rand(SIZE, SIZE, 3) * 255).byte().numpy()
    camera = Camera(SIZE, SIZE, 30.0, 30.0, SIZE / 2, SIZE / 2, torch.eye(3), torch.tensor([0.0, 0.0, 3.0]))
    scene = Scene("noise", [View(camera, "a.png", lambda: pixels)] * 2, [], PointCloud(rand(2, 3)), Protocol("noise"))
    config = GaussianTraining.model_validate({"iterations": STEPS, "sh_interval": 3, **more})
    stage = kind(config, control, fuses_updates=fuses)
    rasterizer, ppl, streams = (
        NegotiatedRasterizer(load_plugins(), device=device),
        PipelineParams(device=device),
        Streams(0),
    )
    stage.begin(StageContext(model, scene, ppl, rasterizer, streams, lambda name: model))
    trainer = Trainer(TrainingState.begin(stage, model, scene, ppl, rasterizer, streams))
    whole, losses = [], []

    def counted(*args, step=stage.whole_step):
        found = step(*args)
        whole.append(found is not None)
        return found

    stage.whole_step = counted
    trainer.run(STEPS, lambda state: losses.append(state.total.item()))
    return trainer.state, losses, whole


def test_a_step_in_one_gives_the_bits_of_its_parts():
    ours, losses, whole = trained(ThreeDGSStage, density=DENSE)
    theirs, expected, none = trained(Parts, density=DENSE)
    assert (whole, none) == ([False] + [True] * (STEPS - 1), [False] * STEPS)  # `render` finds out first who can draw
    assert ours.num_rows == theirs.num_rows > 40  # it has densified
    assert losses == expected
    theirs = theirs.model.state_dict()
    assert all(torch.equal(x, theirs[name]) for name, x in ours.model.state_dict().items())


@pytest.mark.cuda
@pytest.mark.parametrize("fuses", [False, True])
def test_on_a_gpu_too_but_for_the_order_of_sums(fuses):
    ours, losses, whole = trained(ThreeDGSStage, "cuda", fuses=fuses)
    theirs, expected, _ = trained(Parts, "cuda")
    assert sum(whole) == STEPS - 1
    torch.testing.assert_close(torch.tensor(losses), torch.tensor(expected), rtol=1e-4, atol=0)
    for name, x in ours.model.state_dict().items():
        torch.testing.assert_close(x, theirs.model.state_dict()[name], rtol=1e-2, atol=1e-3, msg=name)
    assert {name: ours.optimizer.states[name].step for name in ours.optimizer.states} == {
        name: theirs.optimizer.states[name].step for name in theirs.optimizer.states
    }


def test_whoever_has_something_of_their_own_takes_the_parts():
    control = GaussianTraining().density.model_copy(update={"name": "mcmc"}).load(load_plugins())
    assert not any(trained(ThreeDGSStage, control=control)[2])  # its loss has a term of the scales
    model = trained(ThreeDGSStage)[0].model
    assert is_plain(model)
    handle = model.means.register_hook(lambda grad: grad)
    assert not is_plain(model)
    handle.remove()
    model.quats.grad = torch.zeros_like(model.quats)
    assert not is_plain(model)


def test_a_wrapped_stage_takes_the_parts_of_the_one_around():
    stage = WrappedStage(ThreeDGSStage(GaussianTraining()))
    assert stage.whole_step(None, None, None, None) is None

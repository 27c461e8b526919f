"""The mask: on at the very edge when it starts, degree 2 where it is off, and a penalty that its gradient follows."""

import copy

import pytest
import torch
from sw_kit.short_training import train_stages

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View
from sw_chimerags.method import ChimeraGS
from sw_chimerags.model import LOWER, MaskedGaussians

INIT = -4.5951


@pytest.fixture(scope="module")
def plugins():
    return load_plugins()


@pytest.fixture(scope="module")
def rasterizer(plugins):
    return NegotiatedRasterizer(plugins, device="cpu", prefer=["reference"])


def splats(n: int = 40, seed: int = 0, degree: int = 3) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    rest = 0.3 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g)
    quats = torch.randn(n, 4, generator=g)
    return GaussianModel(
        torch.rand(n, 3, generator=g) - 0.5, 0.5 + torch.rand(n, 1, 3, generator=g), rest,
        torch.randn(n, generator=g), torch.full((n, 3), -2.5), quats,
    )  # fmt: skip


def masked(plugins, model: GaussianModel, init: float = INIT) -> MaskedGaussians:
    return MaskedGaussians.of(model, quantizer=plugins.quantizers.load("ste-mask")(0.01), init=init)


def scene_of() -> Scene:
    up, target = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    eyes = torch.tensor([[0.0, 0, -3], [2.0, 0, -2], [-2.0, 1, -2]])
    views = [
        View(Camera.look_at(e, target, up, width=24, height=16, fov_x=0.7), f"{i}.png") for i, e in enumerate(eyes)
    ]
    return Scene("tiny", views, views[:1], None, Protocol("test"))


def picture(model, rasterizer):
    camera = scene_of().train[1].camera
    return rasterizer.render(model.gaussians(camera, rasterizer), camera, RasterOptions()).image


def test_every_mask_starts_on_at_the_very_edge(plugins):
    model = masked(plugins, splats())
    start = torch.sigmoid(model.mask_logits.detach())
    assert bool((start > 0.01).all())
    assert float(start.max()) < 0.010001
    assert bool(model.mask_on().all())


def test_at_the_start_it_is_the_picture_of_degree_3(plugins, rasterizer):
    plain = splats()
    with torch.no_grad():
        assert torch.allclose(picture(masked(plugins, plain), rasterizer), picture(plain, rasterizer), atol=1e-6)


def test_off_is_the_picture_of_degree_2_without_gradient_to_degree_3_but_to_the_mask(plugins, rasterizer):
    plain, model = splats(), masked(plugins, splats(), init=-5.0)
    zeroed, lower = copy.deepcopy(plain), copy.deepcopy(plain)
    with torch.no_grad():
        zeroed.sh_rest[:, LOWER:] = 0
        lower.active_sh_degree = 2
        expected = picture(lower, rasterizer)
        assert torch.allclose(picture(zeroed, rasterizer), expected, atol=1e-6)
        assert not torch.allclose(picture(plain, rasterizer), expected, atol=1e-3)
    image = picture(model, rasterizer)
    assert torch.allclose(image, expected, atol=1e-6)
    assert not bool(model.mask_on().any())
    image.square().sum().backward()
    assert bool((model.sh_rest.grad[:, LOWER:] == 0).all())
    assert bool((model.sh_rest.grad[:, :LOWER] != 0).any())
    assert int((model.mask_logits.grad != 0).sum()) > 20


def test_bands_that_the_student_lacks_are_zero(plugins, rasterizer):
    model = masked(plugins, splats(degree=1))
    assert model.sh_rest.shape == (40, 15, 3)
    assert bool((model.sh_rest[:, 3:] == 0).all())
    with torch.no_grad():
        assert torch.allclose(picture(model, rasterizer), picture(splats(degree=1), rasterizer), atol=1e-6)


def test_importance_is_of_these_very_gaussians(plugins):
    model = masked(plugins, splats())
    assert not model.has_importance()
    model.set_importance(torch.arange(40.0).index_fill_(0, torch.tensor([3]), -torch.inf))
    assert model.has_importance()
    assert bool(torch.isfinite(model.importance).all())
    resumed = masked(plugins, splats())
    resumed.load_state_dict(model.state_dict())
    resumed.load_state_dict_extra(model.state_dict_extra())
    assert resumed.has_importance()
    with torch.no_grad():
        model.means[0] += 1e-3
    assert not model.has_importance()


def distilled(plugins, rasterizer, student, teacher, **sets):
    values = {
        "distill.iterations": 6,
        "distill.pseudo_view_std": 0.05,
        **{k.replace("__", "."): v for k, v in sets.items()},
    }
    method = ChimeraGS(plugins, resolve(ChimeraGS, "paper", sets=values).config)
    return train_stages(
        method.stages()[-1:], scene_of(), rasterizer, model=lambda: copy.deepcopy(student), trained=lambda name: teacher
    ).model


def test_a_heavy_penalty_turns_every_mask_off(plugins, rasterizer):
    model = distilled(plugins, rasterizer, splats(), splats(seed=1).requires_grad_(False), mask__weight=1e6)
    assert not bool(model.mask_on().any())
    assert model.has_importance()


def test_a_student_that_is_its_teacher_learns_nothing(plugins, rasterizer):
    """No gradient but rounding, which Adam with its tiny epsilon would blow up: l2 has none at all."""
    student = splats()
    model = distilled(
        plugins, rasterizer, student, splats().requires_grad_(False), mask__weight=0, distill__loss="l2",
        distill__lr__position_init=1e-12, distill__lr__position_final=1e-12,
    )  # fmt: skip
    assert torch.allclose(model.sh_dc, student.sh_dc, atol=2e-2)
    assert float(picture(model, rasterizer).sub(picture(student, rasterizer)).abs().max().detach()) < 0.05


def test_the_student_may_teach_itself(plugins, rasterizer):
    method = ChimeraGS(
        plugins, resolve(ChimeraGS, sets={"distill.iterations": 3, "distill.teacher": "student_initial"}).config
    )
    stage = method.stages()[-1]
    assert stage.taught_by == ()
    student = splats()
    student.active_sh_degree = 1
    train_stages([stage], scene_of(), rasterizer, model=lambda: student)  # nothing trained: it would be refused
    assert stage.teacher.active_sh_degree == 3
    assert not any(p.requires_grad for p in stage.teacher.parameters())
    assert torch.equal(stage.teacher.sh_dc, splats().sh_dc)

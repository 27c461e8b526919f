"""The stages of methods on anchors: their plans, rates, statistics and loss."""

import itertools
import statistics
from types import SimpleNamespace

import pytest
import torch
from sw_anchors.anchors import AnchorModel
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.fast.networks import network_outputs
from sw_anchors.params import AnchorGrowth, AnchorParams, CodedAnchorLearningRates, CodedAnchorParams
from sw_anchors.stage import AnchorStage, CodedAnchorStage
from sw_gaussians.resolution import ResolutionPlan, ResolutionSampler, SmallPictures
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import stream
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan

RASTERIZER = ReferenceRasterizer()

PLAN = """\
Stage | Task                        | Plan
------+-----------------------------+------------------------
Pre   | update lr                   | range(30000)
Pre   | update anchor bound         | 1
Post  | collect gradient statistics | range(15000)
Post  | adjust anchor               | range(1500, 3000, 100)
Post  | adjust anchor               | range(4000, 15000, 100)"""


def model_of(cls=CodedAnchors, **kwargs):
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    return cls.from_points(PointCloud(points), voxel_size=0.05, num_offsets=3, feature_dim=4, hidden=6,
                           generator=torch.Generator().manual_seed(1), **kwargs)  # fmt: skip


def scene_of(extent=2.0):
    up, target = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    eyes = torch.tensor([[0.0, 0, -4], [3.0, 0, -3], [-3.0, 1, -3]])
    views = [
        View(Camera.look_at(e, target, up, width=24, height=24, fov_x=1.0), f"{i}.png") for i, e in enumerate(eyes)
    ]
    scene = Scene("tiny", views, views[:1], None, Protocol("test", background="black"))
    return SimpleNamespace(extent=extent, train=scene.train, views=views, points=None)


def begin(stage, model, scene=None):
    return stage.begin(SimpleNamespace(model=model, scene=scene or scene_of(), generator=lambda name: stream(3, name)))


def test_the_plan_is_the_papers():
    assert format_plan(*build_schedulers(CodedAnchorStage(CodedAnchorParams()), PipelineParams())) == PLAN


def test_a_plain_method_has_the_same_plan_without_the_lattice():
    plan = format_plan(*build_schedulers(AnchorStage(AnchorParams()), PipelineParams()))
    assert plan.split("\n") == [line for line in PLAN.split("\n") if "bound" not in line]


def test_a_plain_model_is_trained_by_the_plain_stage():
    stage = AnchorStage(AnchorParams(growth=AnchorGrowth(start_stat=0)))
    scene = scene_of()
    model = begin(stage, model_of(AnchorModel), scene)
    optimizer = stage.create_optimizer(model, scene)
    assert list(optimizer.groups) == ["offsets", "features", "log_scales", "mlp_opacity", "mlp_cov", "mlp_color"]
    view = scene.views[0]
    result = rendered(model, view.camera)
    seen = SimpleNamespace(image=lambda background, device: torch.ones(3, 24, 24))
    pack = stage.loss(model, seen, result, torch.zeros(3), step=1)
    assert set(pack.parts) == {"l1", "ssim", "volume"}
    pack.total.backward()
    before = model.mlp_color[2].weight.detach().clone()
    stage.collect_gradient_statistics(model, result, 1)
    optimizer.step()
    assert bool(model.anchor_denom.any())
    assert not torch.equal(model.mlp_color[2].weight, before)


@pytest.mark.parametrize(
    ("growth", "plans"),
    [
        ({"stop": 2000}, ["range(1500, 2000, 100)"]),
        ({"stop": 3500}, ["range(1500, 3000, 100)"]),
        ({"stop": 1500}, []),
        ({"start": 3500}, ["range(4000, 15000, 100)"]),
        ({"start": 5000}, ["range(5000, 15000, 100)"]),
        ({"pause_end": 2000}, ["range(1500, 3000, 100)", "range(3000, 15000, 100)"]),
    ],
)
def test_anchors_are_adjusted_between_start_and_stop_but_in_the_pause(growth, plans):
    _, post = build_schedulers(AnchorStage(AnchorParams(growth=AnchorGrowth(**growth))), PipelineParams())
    assert [str(each.when) for each in post.registrations if each.name == "adjust anchor"] == plans


def test_a_scaled_plan_keeps_its_shape():
    stage = CodedAnchorStage(CodedAnchorParams(iterations=600, scale_schedule=True))
    plan = format_plan(*build_schedulers(stage, PipelineParams()))
    assert "range(30, 60, 2)" in plan
    assert "range(80, 300, 2)" in plan
    assert stage.learning_rates(600)["mlp_opacity"] == pytest.approx(2e-5)


def test_rates_decay_and_those_of_places_grow_with_the_scene():
    stage = CodedAnchorStage(CodedAnchorParams())
    scene = scene_of(extent=2.0)
    model = begin(stage, model_of(), scene)
    optimizer = stage.create_optimizer(model, scene)
    expected = {
        "offsets": (0.02, 2e-4), "mask_logits": (0.02, 2e-4), "features": (0.0075, 0.0075),
        "log_scales": (0.007, 0.007), "mlp_opacity": (0.002, 2e-5), "mlp_cov": (0.004, 0.004),
        "mlp_color": (0.008, 5e-5),
    }  # fmt: skip
    assert {name: optimizer.lr(name) for name in optimizer.groups} == pytest.approx(
        {k: v[0] for k, v in expected.items()}
    )
    stage.update_lr(optimizer, 30_000)
    assert {name: optimizer.lr(name) for name in optimizer.groups} == pytest.approx(
        {k: v[1] for k, v in expected.items()}
    )
    stage.update_lr(optimizer, 15_000)
    assert optimizer.lr("offsets") == pytest.approx((0.02 * 2e-4) ** 0.5)


def rendered(model, camera):
    return RASTERIZER.render(model.gaussians(camera, RASTERIZER), camera, RasterOptions(grad2d=True))


def test_early_statistics_are_dropped():
    stage = CodedAnchorStage(CodedAnchorParams(growth=AnchorGrowth(start_stat=5)))
    model = begin(stage, model_of())
    result = rendered(model, scene_of().views[0].camera)
    result.image.sum().backward()
    stage.collect_gradient_statistics(model, result, 5)
    assert not bool(model.anchor_denom.any())
    stage.collect_gradient_statistics(model, result, 6)
    assert bool(model.anchor_denom.any())


def test_the_loss_adds_volume_and_what_a_method_adds():
    class More(CodedAnchorStage):
        def extra_loss(self, model, result, step):
            return {"more": (0.5, torch.tensor(0.5 * step)), "as it is": torch.tensor(0.125)}

    stage = More(CodedAnchorParams())
    model, view = begin(stage, model_of()), scene_of().views[0]
    result = rendered(model, view.camera)
    image = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(0))
    seen = SimpleNamespace(image=lambda background, device: image)
    pack = stage.loss(model, seen, result, torch.zeros(3), step=2)
    volume = 0.01 * float(result.inputs.scales.detach().prod(1).mean())
    assert float(pack.parts["volume"]) == pytest.approx(volume)
    assert float(pack.parts["more"]) == 0.5
    expected = 0.8 * float(pack.parts["l1"]) + 0.2 * (1 - float(pack.parts["ssim"])) + volume + 0.5 + 0.125
    assert float(pack.total.detach()) == pytest.approx(expected, rel=1e-5)


def test_a_view_without_gaussians_has_a_finite_loss():
    stage = CodedAnchorStage(CodedAnchorParams())
    model, view = begin(stage, model_of()), scene_of().views[0]
    with torch.no_grad():
        model.mask_logits.fill_(-9)
    result = rendered(model, view.camera)
    seen = SimpleNamespace(image=lambda background, device: torch.zeros(3, 24, 24))
    assert float(stage.loss(model, seen, result, torch.zeros(3), step=1).total.detach()) == 0
    assert model.counts() == {"num_anchors": 0, "num_gaussians": 0}


def test_only_anchors_with_a_lattice_are_trained():
    with pytest.raises(TypeError, match="trains a CodedAnchors, not a AnchorModel"):
        begin(CodedAnchorStage(CodedAnchorParams()), model_of(AnchorModel))


def test_a_rate_that_never_decays_is_constant():
    stage = CodedAnchorStage(CodedAnchorParams(lr=CodedAnchorLearningRates(max_steps=100)))
    assert stage.learning_rates(50)["mlp_cov"] == pytest.approx(0.004)


def test_the_opacity_network_may_wait_until_anchors_are_judged():
    lr = {"mlp_opacity_early": 0.02, "early_until": 1500}
    plain, early = AnchorStage(AnchorParams()), AnchorStage(AnchorParams(lr=lr))
    before, after = plain.learning_rates(1500), plain.learning_rates(1501)
    assert early.learning_rates(1500) == {**before, "mlp_opacity": pytest.approx(0.02 * before["mlp_opacity"])}
    assert early.learning_rates(1501) == after
    shortened = AnchorStage(AnchorParams(lr=lr, iterations=300, scale_schedule=True))  # a hundredth of 30,000 steps
    assert shortened.learning_rates(15)["mlp_opacity"] < shortened.learning_rates(16)["mlp_opacity"]


@pytest.mark.parametrize(("count", "factor"), [(10_000, 0.3), (49_999, 0.3), (50_000, 1.0)])
def test_it_waits_by_itself_where_points_are_few(count, factor):
    stage, scene = AnchorStage(AnchorParams(lr={"mlp_opacity_early": None})), scene_of()
    scene.points = PointCloud(torch.zeros(count, 3))
    begin(stage, model_of(AnchorModel), scene)
    assert stage.learning_rates(9)["mlp_opacity"] == pytest.approx(
        factor * AnchorStage(AnchorParams()).learning_rates(9)["mlp_opacity"]
    )
    given = AnchorStage(AnchorParams(lr={"mlp_opacity_early": 0.5}))
    begin(given, model_of(AnchorModel), scene)
    assert given.early == 0.5


def visible_offsets(seed, **config):
    """Numbers of offsets that each anchor of a fresh model shows to each camera."""
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    model = AnchorModel.from_points(PointCloud(points), voxel_size=0.05, num_offsets=6, feature_dim=4, hidden=6,
                                    generator=torch.Generator().manual_seed(seed))  # fmt: skip
    scene = scene_of()
    begin(AnchorStage(AnchorParams(**config)), model, scene)
    a = model.attributes(torch.arange(model.num_rows))
    networks = (model.mlp_opacity, model.mlp_cov, model.mlp_color)
    seen = [network_outputs(v.camera.center, a.positions, a.features, networks)[0] for v in scene.train]
    return [int(n) for each in seen for n in (each.view(model.num_rows, -1) > 0).sum(1)]


def test_as_many_offsets_are_visible_at_the_start_as_asked_for_whatever_the_seed():
    assert all({*visible_offsets(seed, visible_offsets=3)} == {3} for seed in range(5))
    assert all({*visible_offsets(seed, visible_offsets=99)} == {3} for seed in range(5))  # half of six
    few = [visible_offsets(seed, visible_offsets=1) for seed in range(5)]
    assert all(min(each) == 1 and statistics.fmean(each) < 2 for each in few)
    assert {n for seed in range(5) for n in visible_offsets(seed)} >= {1, 5}


def test_backgrounds_are_random_up_to_a_step_of_the_plan():
    stage = AnchorStage(AnchorParams(random_background_until=1500, iterations=300, scale_schedule=True))
    assert [step for step in range(1, 30) if stage.random_background(step)] == list(range(1, 16))
    assert not AnchorStage(AnchorParams()).random_background(1)


def test_pictures_may_begin_small():
    plain, small = AnchorParams(), AnchorParams(pictures={"schedule": "dash"})
    scene = scene_of()
    assert not isinstance(AnchorStage(plain).create_sampler(scene, stream(0, "sampler")), ResolutionSampler)
    sampler = AnchorStage(small, pictures=SmallPictures).create_sampler(scene, stream(0, "sampler"))
    assert isinstance(sampler, ResolutionSampler)


@pytest.mark.parametrize("iterations", [500, 4_500, 30_000])
def test_statistics_between_two_adjustments_are_of_one_resolution(iterations):
    """The pause, too, ends where adjustments begin again, whatever length the plan is scaled to."""
    stage = AnchorStage(
        AnchorParams(iterations=iterations, scale_schedule=True, pictures={"schedule": "dash", "start": 4.0}),
        pictures=SmallPictures,
    )
    _, post = build_schedulers(stage, PipelineParams())
    adjusts = [entry for entry in post.registrations if entry.task == stage.adjust_anchor]
    rounds = [step for step in range(1, iterations + 1) if any(entry.due(step) for entry in adjusts)]
    sampler = stage.create_sampler(scene_of(), stream(0, "sampler"))
    assert isinstance(sampler, ResolutionSampler)
    sampler._plan = ResolutionPlan((0, iterations // 2), (4.0, 1.0))
    for past, now in itertools.pairwise([0, *rounds]):
        assert len({sampler.scale(step) for step in range(past + 1, now + 1)}) == 1, now
    assert len({sampler.scale(step) for step in rounds}) == len(rounds)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("kind", [AnchorModel, CodedAnchors])
def test_a_step_in_one_has_the_gradients_of_its_parts(kind, device):
    stage = (AnchorStage if kind is AnchorModel else CodedAnchorStage)(CodedAnchorParams())
    model = begin(stage, model_of(kind)).to(device)
    rasterizer, black = NegotiatedRasterizer(load_plugins(), device=device), torch.zeros(3, device=device)
    pixels = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(1)).to(device)
    view = SimpleNamespace(image=lambda background, device: pixels)
    for camera in [v.camera.to(device) for v in scene_of().views] * 3:
        model.zero_grad()
        state = SimpleNamespace(model=model, rasterizer=rasterizer, step=5)
        result, pack = stage.whole_step(state, view, camera, black)
        assert not result.image.requires_grad
        found = {name: p.grad for name, p in model.named_parameters()}

        model.zero_grad()
        inputs = model.gaussians(camera, rasterizer)
        expected = rasterizer.render(inputs, camera, stage.raster_options(5, black))
        loss = stage.loss(model, view, expected, black, 5)
        loss.total.backward()
        torch.testing.assert_close(found, {name: p.grad for name, p in model.named_parameters()})
        torch.testing.assert_close(result.grad2d.value, expected.grad2d.value)
        assert pack.parts.keys() == loss.parts.keys()
        assert pack.total.item() == pytest.approx(loss.total.item(), rel=1e-6)

"""The score: means of alpha times transmittance by hand, the best views, and what no view shows."""

import pytest
import torch
from sw_gaussians.surfels import SurfelModel

from splatwizard_core.errors import ConfigError
from splatwizard_core.rendering.rasterizer import RasterOptions, ScoreSpec
from sw_trimgs.contribution import BestViews, Contribution, ContributionSettings
from sw_trimgs.surfel_contribution import blended, footprint

VIEWS = (0.5, 0.4, 0.6, 0.3, 0.7, 0.1, 0.65)


def mean_of(values, **kwargs):
    best = BestViews(5, **kwargs)
    for value in values:
        best.add(torch.tensor([value, 1.0]))
    return best.mean(torch.zeros(2)).tolist()


def test_the_five_highest_of_seven_views_count():
    assert mean_of(VIEWS) == pytest.approx([(0.7 + 0.65 + 0.6 + 0.5 + 0.4) / 5, 1.0])


def test_of_fewer_views_than_five_all_count():
    assert mean_of(VIEWS[:3]) == pytest.approx([0.5, 1.0])


def test_the_published_rule_shifts_where_the_highest_is_beaten():
    assert mean_of(VIEWS[:5], shift=True) == pytest.approx([(0.7 + 0.6 + 0.5 + 0.5 + 0.5) / 5, 1.0])  # .56
    assert mean_of(VIEWS[:5]) == pytest.approx([0.5, 1.0])


def test_without_a_view_there_is_no_score(make, rasterizer):
    assert Contribution().score(make.cloud(n=3), [], rasterizer).tolist() == [-torch.inf] * 3


def test_the_score_is_the_mean_of_alpha_over_the_footprint(make, rasterizer):
    model = make.gaussians([[0.0, 0.0, 0.0]], [0.6], [0.3])
    camera = make.camera([0.0, 0.0, -4.0])
    alpha = rasterizer.render(
        model.gaussians(camera, rasterizer), camera, RasterOptions(alpha=True)
    ).alpha.detach()  # of one Gaussian the coverage is its alpha
    expected = float(alpha.sum() / (alpha >= 1 / 255).sum())
    assert float(Contribution().score(model, [camera], rasterizer)) == pytest.approx(expected, rel=1e-5)


def test_what_is_hidden_or_out_of_sight_scores_less(make, rasterizer):
    model = make.gaussians([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -9.0]], [0.9, 0.9, 0.9], [0.5, 0.3, 0.3])
    front, behind, unseen = Contribution().score(model, [make.camera([0.0, 0.0, -4.0])], rasterizer).tolist()
    assert 0 < behind < front < 1
    assert unseen == -torch.inf


def test_its_settings_reach_it(make, rasterizer):
    model, camera = make.cloud(n=50), make.camera([0.0, 0.0, -4.0])
    base = Contribution().score(model, [camera], rasterizer)
    assert not torch.equal(base, Contribution(gamma=0.9).score(model, [camera], rasterizer))
    one = Contribution(views=1).score(model, [camera, make.camera([3.0, 0.5, -3.0])], rasterizer)
    assert bool((one >= base).all())
    assert set(ContributionSettings.model_fields) == {"gamma", "views", "count", "top"}
    assert Contribution(**ContributionSettings().model_dump()).views == 5


def test_scoring_leaves_the_model_as_it_is(make, rasterizer):
    model = make.cloud(n=20)
    before = model.digest()
    Contribution().score(model, [make.camera([0.0, 0.0, -4.0])], rasterizer)
    assert model.digest() == before
    assert all(parameter.grad is None for parameter in model.parameters())


def test_a_model_without_own_gaussians_is_refused(rasterizer):
    with pytest.raises(TypeError, match="GaussianModel"):
        Contribution().score(torch.nn.Linear(1, 1), [], rasterizer)


def surfels(means, opacities, scales, quats=None):
    n = len(means)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1) if quats is None else torch.tensor(quats)
    return SurfelModel(
        torch.tensor(means), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), torch.tensor(opacities).logit(),
        torch.tensor(scales).log(), quats,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("mean", "scales", "quat"),
    [
        ([0.0, 0.0, 0.0], [0.2, 0.1], [1.0, 0.0, 0.0, 0.0]),
        ([0.3, -0.2, 0.4], [0.25, 0.1], [0.9, 0.2, 0.3, 0.1]),
        ([0.0, 0.0, 0.0], [0.004, 0.003], [1.0, 0.0, 0.0, 0.0]),  # the low-pass filter decides
        ([1.9, 0.0, 0.0], [0.2, 0.2], [1.0, 0.0, 0.0, 0.0]),  # half of it beyond the image
    ],
)
def test_the_footprint_of_a_surfel_is_the_number_of_its_pixels(make, rasterizer, mean, scales, quat):
    model, camera = surfels([mean], [0.8], [scales], [quat]), make.camera([0.0, 0.0, -4.0], 160, 120)
    drawn = rasterizer.render(model.gaussians(camera, rasterizer), camera, RasterOptions(alpha=True))
    pixels = int((drawn.alpha >= 1 / 255).sum())
    assert pixels > 0
    assert float(footprint(model, camera)) == pytest.approx(pixels, rel=0.12, abs=3)  # pixels are counted whole


def test_the_sum_over_a_surfels_pixels_is_exact(make, rasterizer):
    model = surfels([[0.0, 0.0, 0.0], [0.1, 0.0, 0.5]], [0.7, 0.9], [[0.2, 0.2], [0.3, 0.3]])
    camera = make.camera([0.0, 0.0, -4.0])
    drawn = rasterizer.render(model.gaussians(camera, rasterizer), camera, RasterOptions(alpha=True))
    sums = blended(model, camera, rasterizer)
    assert float(sums.sum()) == pytest.approx(float(drawn.alpha.detach().sum()), rel=1e-4)
    front, behind, unseen = Contribution().score(
        surfels([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -9.0]], [0.9] * 3, [[0.5, 0.5], [0.3, 0.3], [0.3, 0.3]]),
        [camera], rasterizer,
    ).tolist()  # fmt: skip
    assert 0 < behind < front < 1
    assert unseen == -torch.inf


def test_flat_ellipsoids_and_surfels_score_alike(make, rasterizer):
    """Two ways to one number: the scores of a rasterizer, and a gradient over an outline."""
    flat = surfels([[0.0, 0.0, 0.0], [0.4, 0.3, 0.6]], [0.7, 0.9], [[0.3, 0.2], [0.4, 0.4]])
    round_ones = make.gaussians(flat.means.tolist(), [0.7, 0.9], [[0.3, 0.2, 1e-8], [0.4, 0.4, 1e-8]])
    camera = make.camera([0.0, 0.0, -4.0], 160, 120)
    ours = Contribution().score(flat, [camera], rasterizer)
    theirs = Contribution().score(round_ones, [camera], rasterizer)
    assert torch.allclose(ours, theirs, rtol=0.05)


def test_another_exponent_is_refused_for_surfels(make, rasterizer):
    with pytest.raises(ConfigError, match=r"gamma .* 0\.3"):
        Contribution(gamma=0.3).score(
            surfels([[0.0, 0.0, 0.0]], [0.5], [[0.1, 0.1]]), [make.camera([0.0, 0.0, -4.0])], rasterizer
        )


def test_the_counted_pixels_are_those_of_the_rasterizer(make, rasterizer):
    model, camera = make.cloud(n=30), make.camera([0.0, 0.0, -4.0])
    specs = (ScoreSpec("w", "blend", rule="tested"), ScoreSpec("n", "hits", rule="tested"))
    found = rasterizer.accumulate(model.gaussians(camera, rasterizer), [camera], RasterOptions(scores=specs)).scores
    expected = found["w"] / (found["n"] + 1e-6)
    ours = Contribution().score(model, [camera], rasterizer)
    assert torch.allclose(ours.clamp_min(0), expected, atol=1e-6)

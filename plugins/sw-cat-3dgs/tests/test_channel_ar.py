"""Channel-wise model: each slice sees only those before it, in floats and in integers alike."""

import pytest
import torch

from sw_cat_3dgs.channel_ar import ChannelAr


def trained_like(made):
    g = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for p in made.parameters():
            p.add_(torch.randn(p.shape, generator=g) * 0.1)
    return made


def count(module):
    return sum(p.numel() for p in module.parameters())


def test_counts_are_the_papers():
    assert count(ChannelAr((5, 10, 15, 20))) == 14_390
    assert count(ChannelAr((12, 12, 13, 13))) == 15_276
    refined = ChannelAr((12, 12, 13, 13), {"scaling": 6, "offsets": 30})
    assert (count(refined.networks["scaling"]), count(refined.networks["offsets"])) == (6_312, 11_160)


def test_before_training_nothing_is_refined():
    made = ChannelAr((2, 3), {"scaling": 4})
    values, mean, scale = torch.randn(3, 7, 5)
    assert all(torch.equal(a, b) for a, b in zip(made(values, mean, scale), (mean, scale), strict=True))
    assert torch.equal(made.refine("scaling", values, mean[:, :4], scale[:, :4])[0], mean[:, :4])


def test_a_slice_depends_on_earlier_ones_alone():
    made = trained_like(ChannelAr((2, 3, 4), generator=torch.Generator().manual_seed(0)))
    values, mean, scale = torch.randn(3, 6, 9)
    before = torch.stack(made(values, mean, scale))
    for column in range(9):
        changed = values.clone()
        changed[:, column] += 1
        touched = (torch.stack(made(changed, mean, scale)) != before).any(dim=0).any(dim=0)
        own = next(i for i in range(3) if made.part(i).start <= column < made.part(i).stop)
        assert not touched[: made.part(own).stop].any()
        if own < 2:
            assert touched[made.part(own).stop :].all()


def test_integers_follow_the_floats():
    made = trained_like(ChannelAr((2, 3), {"scaling": 4}, generator=torch.Generator().manual_seed(0)))
    values = torch.round(torch.randn(50, 5) * 8 * 4096) / 4096
    fixed = (values * 4096).long()
    exact = made.exact({"scaling": 1000.0})
    mean, scale = made(values, torch.zeros(50, 5), torch.zeros(50, 5))
    found = exact["slice1"](fixed[:, :2]) / 4096
    assert (found - torch.cat([mean[:, 2:], scale[:, 2:]], dim=1)).abs().max() < 2e-2
    shift, widening = made.refine("scaling", values, torch.zeros(50, 4), torch.zeros(50, 4))
    found = exact["scaling"](fixed) / 4096 / 1000
    assert (found - torch.cat([shift, widening], dim=1)).abs().max() < 5e-2
    assert torch.equal(exact["slice1"](fixed[:9, :2]), exact["slice1"](fixed[:, :2])[:9])


def test_slices_must_be_sizes():
    for slices in ((), (3, 0)):
        with pytest.raises(ValueError, match="slices"):
            ChannelAr(slices)

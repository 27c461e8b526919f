"""Sensitivity and its codebook are parts for everybody: other methods take them by name."""

import pytest
import torch

from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel, create_method
from splatwizard_core.plugins import load_plugins
from sw_codecs.vectors.sensitivity_vq import SensitivityVQ

PLUGINS = load_plugins()
needs_c3dgs = pytest.mark.skipif("c3dgs" not in PLUGINS.methods, reason="sw-c3dgs is not installed")
SMALL = {"size": 8, "training": "kmeans", "iterations": 3, "threshold": 30.0}


def students(n=60):
    """Gaussians of ChimeraGS with an importance that rises along the rows."""
    from sw_chimerags.model import MaskedGaussians

    g = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=g)

    plain = GaussianModel(
        normal(n, 3), normal(n, 1, 3), normal(n, 15, 3) / 5, normal(n), normal(n, 3) - 3, normal(n, 4)
    )
    model = MaskedGaussians.of(plain, quantizer=PLUGINS.quantizers.load("ste-mask")(0.01), init=-6.0)
    with torch.no_grad():
        model.mask_logits[::3] = 1.0
    model.set_importance(torch.arange(n).float())
    return model


def test_chimerags_writes_its_colours_with_sensitivity_vq():
    method = create_method(
        PLUGINS, "chimerags", {"codec": "sensitivity-vq", **{f"codec.settings.{k}": v for k, v in SMALL.items()}}
    )
    model, writer = students(), ContainerWriter("chimerags", method.version)
    method.encode(model, writer)
    assert {"sh2/vq/lattice", "sh3/vq/entries"} <= set(writer.sections)
    found = type(method)(PLUGINS, None).decode(ContainerReader(writer.to_bytes(), "file.swz"))
    own = {tuple(row.tolist()) for row in model.means[31:]}
    kept = [i for i, row in enumerate(found.means) if tuple(row.tolist()) in own]
    at = {tuple(row.tolist()): i for i, row in enumerate(model.means)}
    wanted = model.sh_dc[[at[tuple(found.means[i].tolist())] for i in kept]]
    assert len(kept) == 29
    assert float((found.sh_dc[kept] - wanted).detach().abs().max()) < 0.02  # half a step of 8 bits
    assert len(torch.unique(found.sh_dc.detach(), dim=0)) <= 29 + 16


def test_it_is_one_of_the_coders_that_a_user_may_name():
    assert PLUGINS.vector_coders.load("sensitivity-vq") is SensitivityVQ


@needs_c3dgs
@pytest.mark.parametrize("method", ["lightgaussian", "pup-3dgs", "trimming-the-fat", "speedy-splat"])
def test_methods_that_prune_may_do_so_by_sensitivity(method):
    made = create_method(PLUGINS, method, {"prune.pruner": "sensitivity", "prune.settings.kind": "shape"})
    pruner = made.config.prune.load(PLUGINS)
    assert (type(pruner).__name__, pruner.kind) == ("Sensitivity", "shape")

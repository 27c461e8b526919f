"""Bytes that are alive at once while a scene is compressed, for each Gaussian: counted, as resident memory never is."""

import weakref

import pytest
import torch
from sw_compress import compress, rounding
from sw_compress import source as sources
from sw_compress.coders import Quantized
from sw_compress.rounding import NAMES, Rounding, Steps
from sw_compress.rows import IMPORTANCE
from sw_gaussians import heap, merging, simplifying
from sw_gaussians.simplifying import merged_by
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from splatwizard_core.api import GaussianModel
from splatwizard_core.tooling import export_model, load_plugins

COUNT = 3_000
MODEL = 236
"""Bytes of a Gaussian of SH degree 3."""


class Alive(TorchDispatchMode):
    """Counts the bytes of the tensors that operations make until these go, beside those of the source."""

    def __init__(self, source: GaussianModel) -> None:
        super().__init__()
        self._known = {getattr(source, name).data_ptr(): 0 for name in (*source.RAW, IMPORTANCE)}
        self.most = 0

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        found = operation(*args, **(kwargs or {}))
        for each in tree_leaves(found):
            if isinstance(each, torch.Tensor) and each.untyped_storage().data_ptr() not in self._known:
                place = each.untyped_storage().data_ptr()
                self._known[place] = each.untyped_storage().nbytes()
                weakref.finalize(each, self._known.pop, place, None)
        self.most = max(self.most, sum(self._known.values()))
        return found

    @property
    def per_gaussian(self) -> float:
        return self.most / COUNT


@pytest.fixture
def source(ball, monkeypatch) -> GaussianModel:
    monkeypatch.setattr(merging, "ROWS_AT_ONCE", 128)  # blocks as small against the whole as those of a million are
    monkeypatch.setitem(rounding.ROWS_AT_ONCE, "cpu", 128)
    monkeypatch.setitem(simplifying.PAIRS_AT_ONCE, "cpu", 128)
    model = ball(COUNT, degree=3)
    model.opacity_logits.clamp_(min=-5)  # what cannot be drawn goes first, as it does when a file is read
    setattr(model, IMPORTANCE, torch.rand(COUNT, generator=torch.Generator().manual_seed(0)))
    return model


def test_one_rounded_model_is_all_that_sensitivities_need(source):
    fine, coarse = (Steps(dict.fromkeys(NAMES.values(), step), 15) for step in (0.01, 0.1))
    with Alive(source) as alive:
        known = Rounding(source, 0.4, True)
        whole = known.model_at(fine)
        for name in NAMES.values():
            known.change(whole, name, coarse)
    assert MODEL < alive.per_gaussian < MODEL + 150


def test_merging_needs_what_is_left_about_twice(source):
    rows = torch.arange(0, COUNT * 9 // 10)
    with Alive(source) as alive:
        merged_by(source, rows, COUNT // 2, getattr(source, IMPORTANCE)[rows])
    assert MODEL < alive.per_gaussian < 2.5 * MODEL


def test_coefficients_of_the_source_lie_in_a_file_while_others_are_coded(ball, tmp_path, monkeypatch):
    export_model(ball(400, degree=2), tmp_path / "ball.ply", load_plugins())
    aside, coded = [], Quantized.encode

    def watched(*args):
        aside.append(sum(len(each) for each in heap.in_files()))
        return coded(*args)

    monkeypatch.setattr(Quantized, "encode", watched)
    usual = compress(tmp_path / "ball.ply", size=6_000, views=6, device="cpu").data
    monkeypatch.setattr(sources, "MANY", 100)
    assert compress(tmp_path / "ball.ply", size=6_000, views=6, device="cpu").data == usual
    half = len(aside) // 2
    assert set(aside[:half]) == {0}
    assert all(each >= 300 * 4 * 24 for each in aside[half:])
    assert sum(len(each) for each in heap.in_files()) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["ball.ply"]

"""Drawing through the plain C face: memory that is used again, a guess at pairs that was too small, what is refused."""

from __future__ import annotations

import gc
import math

import pytest
import torch
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene

from splatwizard_core.api import RasterOptions
from sw_rasterizers import cpu, face, memory
from sw_rasterizers.call import INPUTS, Call, Flag, camera_numbers
from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer
from sw_rasterizers.surfel import SurfelRasterizer

needs_kernels = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
MEGABYTES = 1 << 20


@pytest.fixture
def recycler(monkeypatch):
    mine = memory._Recycler()
    monkeypatch.setattr(memory, "_RECYCLER", mine)
    return mine


def test_a_block_is_handed_out_again_when_no_view_of_it_is_left(recycler):
    first = memory.empty((3, MEGABYTES), torch.float32)
    place, view = first.data_ptr(), first[1:, 5:]
    view.fill_(7)
    del first
    second = memory.empty((3, MEGABYTES), torch.float32)
    assert second.data_ptr() != place
    second.fill_(1)
    assert view.eq(7).all()
    del view
    third = memory.empty((5 * MEGABYTES,), torch.int16)
    assert third.data_ptr() == place
    assert third.data_ptr() % 64 == 0


def test_no_more_is_kept_than_was_in_use_at_once(recycler):
    sizes = [3, 17, 40, 5, 60, 2, 33]
    held = [memory.empty((size * MEGABYTES,), torch.uint8) for size in sizes[:3]]
    del held
    for size in sizes:
        memory.empty((size * MEGABYTES,), torch.uint8)
        assert sum(map(len, recycler._idle)) + recycler._used_bytes <= recycler._most_used
    assert recycler._most_used <= (3 + 17 + 40 + 3) * MEGABYTES


def test_tensors_that_are_freed_while_memory_is_taken_do_not_wait_for_themselves(recycler):
    """The garbage collector may free a tensor at any allocation, also inside of the recycler."""
    for _ in range(50):
        cycle = [memory.empty((2 * MEGABYTES,), torch.uint8)]
        cycle.append(cycle)
    with recycler._lock:
        del cycle
        gc.collect()
    assert len(recycler._returned) > 0
    memory.empty((2 * MEGABYTES,), torch.uint8)
    assert len(recycler._returned) == 1


def test_small_tensors_are_torchs_own(recycler):
    assert memory.empty((0, 5, 3), torch.float64).shape == (0, 5, 3)
    memory.empty((100, 3), torch.float32)
    assert recycler._most_used == 0


@needs_kernels
@pytest.mark.parametrize("surfels", [False, True])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_guess_at_the_pairs_that_was_too_small_changes_nothing(surfels, threads, monkeypatch):
    case = RasterCase(
        "wide", n=4000, width=200, height=150, scale=(1.0, 2.0), geometry="surfels" if surfels else "scales"
    )
    g, cam = draw_scene(case, 0, torch.float32)
    rasterizer, before = (SurfelRasterizer if surfels else StandardRasterizer)(), torch.get_num_threads()
    calls, project = [], face.project
    monkeypatch.setattr(face, "project", lambda **arguments: calls.append(1) or project(**arguments))

    def draw(recent: int) -> tuple[torch.Tensor, int]:
        calls.clear()
        cpu._Listed.recent = recent
        return rasterizer.render(g, cam, RasterOptions()).image, len(calls)

    torch.set_num_threads(threads)
    try:
        (twice, first), (once, second) = draw(0), draw(10**6)
    finally:
        torch.set_num_threads(before)
    assert (first, second) == (2, 1)
    assert torch.equal(twice, once)


def sight(flags: Flag) -> tuple[cpu.Picture, dict[str, torch.Tensor | None]]:
    g, cam = draw_scene(RasterCase("few", n=20), 1, torch.float32)
    tensors = dict.fromkeys(INPUTS)
    tensors |= {"means": g.means, "opacities": g.opacities, "scales": g.scales, "quats": g.quats, "sh": g.sh.dense}
    tensors = {name: None if x is None else x.float().contiguous() for name, x in tensors.items()}
    call = Call(camera_numbers(cam), cam.width, cam.height, 3, 1.0, 0.3, flags)
    return cpu.Picture(call, tensors, int(flags)), tensors


@needs_kernels
@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"sh": torch.zeros(20, 9, 3)}, "SH degree 3 needs 16 coefficients, got 9"),
        ({"sh": None}, "SH degree 3 needs 16 coefficients, got 1"),
        ({"colors": torch.zeros(20, 3)}, "exclude each other"),
        ({"quats": None}, "either scales and quats or cov3d is needed"),
        ({"cov3d": torch.zeros(20, 6)}, "either scales and quats or cov3d is needed"),
        ({"opacities": torch.zeros(19)}, r"opacities must be a contiguous .* got torch.float32 \[19\]"),
        ({"opacities": torch.zeros(20, dtype=torch.float64)}, "opacities must be a contiguous .* got torch.float64"),
        ({"scales": torch.ones(20, 2)}, r"scales must be \[20, 3\], got 2 columns"),
    ],
)
def test_tensors_that_do_not_fit_together_are_refused(change, told):
    picture, tensors = sight(Flag.TIGHT)
    with pytest.raises(RuntimeError, match=told):
        cpu.draw(picture, {**tensors, **change})


@needs_kernels
def test_memory_that_is_too_small_is_refused():
    picture, tensors = sight(Flag.TIGHT | Flag.SAVE)
    projected = cpu.project(picture, tensors)
    short = projected._replace(splats=projected.splats[:640])
    with pytest.raises(RuntimeError, match=r"draw: splats needs \d+ bytes from a multiple of 64 on, got \d+"):
        cpu.make_lists(picture, short, None)
    shifted = torch.empty(len(projected.splats) + 4, dtype=torch.uint8)[4:]
    with pytest.raises(RuntimeError, match="splats needs"):
        cpu.make_lists(picture, projected._replace(splats=shifted), None)
    drawn = cpu.draw(picture, tensors)
    by = {"image": torch.ones_like(drawn.image)}
    for kept, told in (
        (drawn.kept._replace(sum_bytes=64), "sums needs"),
        (drawn.kept._replace(lists=drawn.kept.lists[:64]), "lists needs"),
        (drawn.kept._replace(pairs=-1), "-1 pairs"),
    ):
        with pytest.raises(RuntimeError, match=told):
            cpu.draw_backward(picture, tensors, kept, by, {"means"})
    with pytest.raises(RuntimeError, match="no median depth was drawn"):
        cpu.draw_backward(picture, tensors, drawn.kept, {**by, "median": by["image"][:1].clone()}, {"means"})
    plain, _ = sight(Flag.TIGHT)
    with pytest.raises(RuntimeError, match="kept no state"):
        cpu.draw_backward(plain, tensors, cpu.draw(plain, tensors).kept, by, {"means"})


@needs_kernels
def test_a_drawing_of_float64_is_told_by_its_means():
    g, cam = draw_scene(RasterCase("few", n=20), 1, torch.float64)
    image = StandardRasterizer().render(g, cam, RasterOptions()).image
    single = StandardRasterizer().render(cast_inputs(g, torch.float32), cam, RasterOptions()).image
    assert image.dtype == torch.float64
    assert math.isclose(image.sum().item(), single.sum().item(), rel_tol=1e-4)

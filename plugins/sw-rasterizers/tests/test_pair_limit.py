"""A small file can ask for any number of splat-tile pairs: they are counted, and refused before they are listed."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene, front_camera, with_tensors

from splatwizard_core.api import Camera, GaussianInputs, RasterOptions, ScoreSpec
from splatwizard_core.base.memory import MemoryMeter
from sw_rasterizers import cuda
from sw_rasterizers.inference import FlashRasterizer
from sw_rasterizers.native import MODULE, unavailable_on_cuda
from sw_rasterizers.standard import StandardRasterizer
from sw_rasterizers.surfel import SurfelRasterizer

pytestmark = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
WITH_GPU = (
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda())),
)
ON_GPU = pytest.mark.parametrize("device", [pytest.param("cuda", marks=WITH_GPU)])
LIMIT = "SPLATWIZARD_MAX_TILE_PAIRS"
SCORES = RasterOptions(scores=(ScoreSpec("h", "hits"), ScoreSpec("s", "grad_sq")), fisher=True)


@dataclass(frozen=True)
class Way:
    """A way to draw: with which class, in training or not, scores alone or a picture."""

    kind: type[StandardRasterizer] | type[SurfelRasterizer]
    training: bool = False
    scores: bool = False

    def draw(self, g: GaussianInputs, cam: Camera) -> torch.Tensor:
        rasterizer = self.kind()
        if self.scores:
            return rasterizer.accumulate(g, [cam], SCORES).scores["h"]
        with torch.set_grad_enabled(self.training):
            return rasterizer.render(g, cam, RasterOptions()).image.detach()


STANDARD, TRAINING = Way(StandardRasterizer), Way(StandardRasterizer, training=True)
SURFELS, FLASH = Way(SurfelRasterizer), Way(FlashRasterizer)
COUNTED = Way(StandardRasterizer, scores=True)
WAYS = [
    *(pytest.param(way, "cpu", id=f"cpu-{name}") for name, way in (
        ("standard", STANDARD), ("training", TRAINING), ("surfels", SURFELS), ("scores", COUNTED))),
    *(pytest.param(way, "cuda", id=f"cuda-{name}", marks=WITH_GPU) for name, way in (
        ("standard", STANDARD), ("training", TRAINING), ("surfels", SURFELS), ("scores", COUNTED), ("flash", FLASH))),
]  # fmt: skip


def full_screen(n: int, way: Way, device: str) -> GaussianInputs:
    """n equal splats that cover the whole picture."""
    geometry = "surfels" if way.kind is SurfelRasterizer else "scales"
    case = RasterCase("wide", n=n, spread=0.0, scale=(9.0, 9.0), degree=0, active_degree=0, geometry=geometry)
    g, _ = draw_scene(case, 0, torch.float32)
    facing = {"means": torch.tensor([0.0, 0.0, 4.0]).repeat(n, 1), "quats": torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)}
    g = cast_inputs(with_tensors(g, facing), torch.float32, device)
    floating = {k: x.requires_grad_() for k, x in g.tensors().items() if way.training and x.is_floating_point()}
    return with_tensors(g, floating)


@pytest.mark.parametrize(("way", "device"), WAYS)
def test_more_pairs_than_the_limit_are_refused_and_the_next_call_draws(way, device, monkeypatch):
    g, cam = full_screen(50, way, device), front_camera(64, 64)
    half = device == "cpu" and way.training  # 70 bytes a pair there, so that each counts for two
    pairs = 50 * 16
    whole = way.draw(g, cam)
    monkeypatch.setenv(LIMIT, str(pairs * (1 + half)))
    assert torch.equal(way.draw(g, cam), whole)
    monkeypatch.setenv(LIMIT, str((pairs - 1) * (1 + half)))
    for _ in range(3):
        with pytest.raises(RuntimeError, match=rf"^sw_rasterizers: 800 splat-tile pairs are more than 799: .* {LIMIT}"):
            way.draw(g, cam)
    monkeypatch.delenv(LIMIT)
    assert torch.equal(way.draw(g, cam), whole)


@pytest.mark.parametrize(("way", "device"), WAYS)
def test_pairs_of_splats_whose_colours_are_not_finite_count_too(way, device, monkeypatch):
    """They draw nothing; but while they fill the lists, there is no room for those of the splats behind them."""
    g, cam = full_screen(3000, way, device), front_camera(64, 64)
    with torch.no_grad():
        g.sh.dense[:2990] = float("nan")
    whole = way.draw(g, cam)
    monkeypatch.setenv(LIMIT, "2000")
    with pytest.raises(RuntimeError, match=r"48000 splat-tile pairs are more than (2000|1000): "):
        way.draw(g, cam)
    monkeypatch.setenv(LIMIT, str(2 * 48_000))
    assert torch.equal(way.draw(g, cam), whole)


@pytest.mark.parametrize("way", [STANDARD, SURFELS], ids=["standard", "surfels"])
def test_a_refused_call_takes_no_memory_for_its_pairs_on_the_cpu(way, monkeypatch):
    """A thousand splats are projected at once; 16,384 tiles each are 65 MB."""
    g, cam, memory = full_screen(1000, way, "cpu"), front_camera(2048, 2048, fx=2048.0, fy=2048.0), MemoryMeter("cpu")
    monkeypatch.setenv(LIMIT, "100000")
    memory.start()
    with pytest.raises(RuntimeError, match="16384000 splat-tile pairs are more than 100000: "):
        way.draw(g, cam)
    assert memory.peak_bytes() < 20e6


@ON_GPU
@pytest.mark.parametrize("way", [STANDARD, TRAINING], ids=["standard", "training"])
def test_a_refused_call_takes_no_memory_for_its_pairs(way, device, monkeypatch):
    """65,536 splats over 1600x1200 pixels: 492 million pairs, 6 GB, from 858 bytes of file."""
    monkeypatch.setattr(cuda._Recent, "splats", 0)
    monkeypatch.setattr(cuda._Recent, "pairs", 0)
    g, cam = full_screen(65_536, way, device), front_camera(1600, 1200, fx=1600.0, fy=1600.0)
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    with pytest.raises(RuntimeError, match=rf"{65_536 * 7500} splat-tile pairs are more than {2**27}: "):
        way.draw(g, cam)
    pixels = 5 * 4 * 1600 * 1200  # the picture, and in training light and place of each of its pixels
    assert torch.cuda.max_memory_allocated() - before < 200 * 65_536 + pixels
    assert torch.cuda.memory_allocated() == before


@ON_GPU
def test_a_call_after_a_refused_one_on_another_stream_reads_its_own_counts(device, monkeypatch):
    """A count of colours that are not finite, which the refused call still writes, is not taken for the next one's."""
    many, cam = full_screen(200_000, STANDARD, device), front_camera(320, 320)
    many.sh.dense[:] = float("nan")
    few = full_screen(3, STANDARD, device)
    monkeypatch.setenv(LIMIT, "5000")
    side = torch.cuda.Stream()
    for _ in range(20):
        with torch.cuda.stream(side), pytest.raises(RuntimeError, match="more than 5000"):
            STANDARD.draw(many, cam)
        stats = StandardRasterizer().render(few, cam, RasterOptions()).stats
        assert (stats.n_visible, stats.n_pairs, stats.n_invalid) == (3, 3 * 400, 0)


@ON_GPU
def test_scores_of_a_small_picture_keep_no_state_for_a_backward_pass(device):
    """Pieces of lists would be 16 bytes a pair more than the lists themselves take while they are sorted."""
    g, cam = full_screen(2000, COUNTED, device), front_camera(256, 256)
    pairs = 2000 * 256

    def peak(way: Way) -> int:
        way.draw(g, cam)
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        way.draw(g, cam)
        return torch.cuda.max_memory_allocated() - before

    assert peak(COUNTED) - peak(STANDARD) < 4 * pairs

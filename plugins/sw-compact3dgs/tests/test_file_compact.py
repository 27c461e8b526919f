"""The file of Compact3DGS: what comes back, what it costs, that it is complete, and safe against strangers."""

import copy
import struct

import numpy as np
import pytest
import torch
from compact_models import PLUGINS, decoded, encoded, make, method, written
from forked_children import run_python
from sw_compact3dgs.file import OPACITY
from sw_compact3dgs.method import Compact3DGS
from sw_compact3dgs.model import PLAIN, SMALLEST_SCALE
from sw_kit.hostile_files import Mutator, Parts, Tally, attempt
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.coding.container import ContainerReader, decoded_limit
from splatwizard_core.errors import BitstreamError, ConfigError, SceneError, SplatwizardError
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.decode import decode_model
from sw_codecs.positions.ordering import spatial_order

RASTERIZER = ReferenceRasterizer()
FORMS = {"pp": {}, "plain": {"codec__settings__pp": False}}
PARTS = ("header", "codebooks", "indices")
SECTIONS = {"positions", "opacities", "grid", "network", *(f"{p}/{n}" for p in ("scales", "rotations") for n in PARTS)}


def order_of(model) -> torch.Tensor:
    """Rows of the file."""
    kept = torch.nonzero(model.mask_on()).squeeze(1)
    return kept[spatial_order(model.means.detach()[kept].half().float())]


@pytest.mark.parametrize("form", FORMS)
def test_the_decoder_has_what_the_encoder_chose(form):
    model = make()
    before = copy.deepcopy(model).digest()
    found, rows = decoded(encoded(model, **FORMS[form])), order_of(model)
    assert model.digest() == before
    assert found.counts() == {"num_gaussians": 295}
    assert torch.equal(found.means, model.means[rows].half().float())
    scales = model.scale_vq.forward(model.scales).detach()[rows].clamp_min(SMALLEST_SCALE)
    assert torch.equal(found.scales, scales)
    assert torch.equal(found.quats, model.quat_vq.forward(model.unit_quats()).detach()[rows])
    opacities = model.opacities.detach()[rows]
    error = (found.opacities - opacities).abs()
    if form == "pp":
        assert float(error.max()) <= float(opacities.max() - opacities.min()) / 510 * 1.001
    else:
        assert torch.equal(found.opacities, opacities.half().float())
    for layer, mine in zip(found.color.layers, model.color.layers, strict=True):
        assert torch.equal(layer.weight, mine.weight.half().float())


def test_the_plain_grid_is_float16_and_the_processed_one_has_256_values_and_zeros():
    model = make()
    table = model.color.grid.table.detach()
    assert torch.equal(decoded(encoded(model, **FORMS["plain"])).color.grid.table, table.half().float())
    found = decoded(encoded(model)).color.grid.table.detach()
    step = float(table.max() - table.min()) / 255
    small = table.abs() <= 0.1
    assert bool((found[small] == 0).all())
    assert float((found - table)[~small].abs().max()) <= step / 2 * 1.001 + step / 2  # the lattice is shifted to hold 0
    assert len(found.unique()) <= 256
    assert float((found == 0).float().mean()) < 0.2


def test_a_coarser_threshold_makes_a_smaller_file():
    sizes = [len(encoded(make(log2_size=10), codec__settings__grid_threshold=t)) for t in (0.0, 0.5, 1.5)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[2] < 0.9 * sizes[0]


def test_steps_of_the_grid_are_no_shorter_than_asked_and_round_to_the_nearest():
    table = make().color.grid.table.detach()
    values = {"codec__settings__grid_threshold": 0, "codec__settings__grid_step": 0.25}
    found = decoded(encoded(make(), **values)).color.grid.table.detach()
    torch.testing.assert_close(found, torch.round(table / 0.25) * 0.25, atol=1e-5, rtol=0)
    twice = decoded(encoded(make(), **values, codec__settings__grid_factor=2)).color.grid.table.detach()
    torch.testing.assert_close(twice, torch.round(table / 0.5) * 0.5, atol=1e-5, rtol=0)
    published = {"codec__settings__grid_threshold": 0}
    shorter = encoded(make(), **published, codec__settings__grid_step=1e-4)  # than the range / 255
    assert shorter == encoded(make(), **published)


def test_the_factor_of_a_rate_point_multiplies_the_threshold():
    twice = encoded(make(), codec__settings__grid_threshold=0.2, codec__settings__grid_factor=2)
    assert twice == encoded(make(), codec__settings__grid_threshold=0.4)


@pytest.mark.parametrize(("threshold", "step"), [(0.5, 0.45), (1.0, 0.9), (1.5, 1.5)])
def test_for_fewer_bytes_long_steps_change_the_grid_less_than_zeros(threshold, step):
    model = make(log2_size=10)
    table = model.color.grid.table.detach()
    sizes, errors = [], []
    for values in ((threshold, 0), (0, step)):
        settings = dict(zip(("codec__settings__grid_threshold", "codec__settings__grid_step"), values, strict=True))
        file = written(model, **settings)
        sizes.append(file.sections["grid"])
        errors.append(float((decoded(file.to_bytes()).color.grid.table - table).square().mean()))
    assert sizes[1] <= sizes[0]
    assert errors[1] < 0.75 * errors[0]


@pytest.mark.parametrize("form", FORMS)
def test_the_file_renders_as_the_model_with_rounded_positions(form):
    model, cam = make(), front_camera()
    found = decoded(encoded(model, **FORMS[form]))
    with torch.no_grad():
        rounded = make()
        rounded.means.copy_(rounded.means.half())
        images = [RASTERIZER.render(m.gaussians(cam, RASTERIZER), cam, RasterOptions()).image for m in (found, rounded)]
        # Positions are rounded after shapes and before colours: the same tensors, the same picture.
        assert float((images[0] - images[1]).abs().mean()) < (0.02 if form == "pp" else 1e-3)
        cached = copy.deepcopy(found)
        cached.prepare()
        again = RASTERIZER.render(cached.gaussians(cam, RASTERIZER), cam, RasterOptions()).image
    torch.testing.assert_close(images[0], again, atol=1e-6, rtol=0)
    assert cached.digest() == found.digest()  # the cache is no state


def test_another_process_decodes_the_same(tmp_path):
    paths = []
    for form, values in FORMS.items():
        paths.append(tmp_path / f"{form}.swz")
        paths[-1].write_bytes(encoded(make(), **values))
    code = (
        "import sys, torch\n"
        "from splatwizard_core.coding.container import ContainerReader\n"
        "from sw_compact3dgs.method import Compact3DGS\n"
        "from splatwizard_core.plugins import load_plugins\n"
        "torch.set_num_threads(2)\n"
        "for path in sys.argv[1:]:\n"
        "    print(Compact3DGS(load_plugins(), None).decode(ContainerReader.open(path)).digest())\n"
    )
    found = run_python("-c", code, *map(str, paths), check=True)
    assert found.stdout.split() == [decoded(path.read_bytes()).digest() for path in paths]


def test_sections_and_requirements():
    for values in FORMS.values():
        reader = ContainerReader(encoded(make(), **values))
        assert set(reader.sections) == SECTIONS
        assert reader.size == reader.header_bytes + sum(reader.sections.values())
    assert reader.static["form"] == "plain"
    assert reader.raster["sh_degree"] == 0


def test_the_size_is_17_bytes_a_gaussian_two_a_number_of_the_grid_and_the_codebooks():
    n = 1200
    model = make(n, off=0, size=64, stages=6, log2_size=9, hidden=64)
    sections = written(model, **FORMS["plain"]).sections
    grid = 2 * model.color.grid.table.numel()
    weights = 2 * sum(layer.weight.numel() for layer in model.color.layers)
    codebooks = 4 * 6 * 64 * (3 + 4)
    assert codebooks == 10_752
    assert sections["scales/indices"] == sections["rotations/indices"] == n * 36 // 8
    expected = 17 * n + grid + weights + codebooks
    assert expected <= sum(sections.values()) < expected + 200


def test_huffman_saves_and_every_entropy_coder_gives_the_same_scene():
    model = make(2000, log2_size=9)
    with torch.no_grad():
        model.color.grid.table.pow_(3)  # most of it small, as when it was trained
        model.log_scales.copy_(torch.where(torch.rand(2000, 1) < 0.7, -3.0, model.log_scales))
    plain, files = (
        encoded(model, **FORMS["plain"]),
        {c: encoded(model, codec__settings__coder=c) for c in ("huffman", "range", "rans")},
    )
    assert len(files["huffman"]) < 0.75 * len(plain)
    assert len(files["range"]) < len(files["huffman"])
    assert len({decoded(data).digest() for data in files.values()}) == 1


def test_encoding_again_gives_the_same_bytes():
    model = make()
    assert encoded(model) == encoded(model)


def test_equal_values_are_no_division_by_zero():
    model = make()
    with torch.no_grad():
        model.opacity_logits.fill_(0.3)
        model.color.grid.table.fill_(0.05)
        model.log_scales.fill_(-3.0)
    model.fit_codebooks(3)
    for values in FORMS.values():
        found = decoded(encoded(model, **values))
        assert float((found.opacities - torch.sigmoid(torch.tensor(0.3))).abs().max()) < 1e-3
        torch.testing.assert_close(found.scales, model.scales[:295].detach(), rtol=1e-3, atol=0)


def test_one_gaussian():
    model = make(1, off=0)
    for values in FORMS.values():
        assert torch.equal(decoded(encoded(model, **values)).means, model.means.half().float())


def test_an_untrained_model_gets_its_codebooks_at_the_end(caplog):
    model = make(600, size=64, stages=6)
    model.phase = PLAIN
    found, rows = decoded(encoded(model)), order_of(model)
    assert "codebooks" in caplog.text
    assert model.phase == PLAIN
    assert float((found.scales - model.scales.detach()[rows]).abs().mean()) < 0.02 * float(model.scales.detach().mean())


def test_far_positions_are_kept_in_the_range_of_float16():
    model = make()
    with torch.no_grad():
        model.means[20] = torch.tensor([1e6, -1e6, 3.0])
    found = decoded(encoded(model)).means
    assert (float(found.max()), float(found.min())) == (65504, -65504)


def test_what_cannot_be_encoded_is_said():
    model = make()
    with torch.no_grad():
        model.means[7] = torch.nan
    with pytest.raises(SplatwizardError, match="not finite"):
        encoded(model)
    with pytest.raises(SplatwizardError, match="mask"):
        encoded(make(5, off=5))
    for where in ("table", "weight"):
        model = make()
        with torch.no_grad():
            (model.color.grid.table if where == "table" else model.color.layers[0].weight)[0] = 1e9
        with pytest.raises(SplatwizardError, match="finite"):
            encoded(model, codec__settings__pp=False)
    with pytest.raises(ConfigError, match="entropy coder"):
        method(codec__settings__coder="octree").stages()
    with pytest.raises(TypeError, match="its own Gaussians"):
        method().encode(torch.nn.Module(), None)


def test_no_ply_is_made_of_it(tmp_path):
    export = PLUGINS.exporters.load("ply")
    with pytest.raises(SceneError, match="depend on the camera"):
        export(decoded(encoded(make())), tmp_path / "scene.ply")


# Hostile files


def changed(data: bytes, **values) -> bytes:
    parts = Parts.of(data)
    parts.header["static"].update(values)
    return parts.join()


def with_section(data: bytes, name: str, content: bytes) -> bytes:
    parts = Parts.of(data)
    parts.sections = [(each, content if each == name else old) for each, old in parts.sections]
    return parts.join()


def refused(data: bytes, match: str) -> None:
    with pytest.raises(BitstreamError, match=match):
        decoded(data)


def test_header_values_out_of_range_are_refused():
    data = encoded(make(n=40))
    for key, bad in (
        ("num_gaussians", [0, -1, 41, 1 << 32, None, 34]), ("form", ["?", None, "plain"]),
        ("coder", ["octree", 3, "range"]),
        ("grid_levels", [0, 33, 5, 3]), ("grid_features", [0, 9, 1, 3]), ("grid_coarsest", [1, 1025, "4"]),
        ("grid_growth", [0.5, 4.5, "1", None]), ("grid_log2", [2, 25, 5, 7]), ("hidden", [0, 257, 7, 9]),
    ):  # fmt: skip
        for value in bad:
            with pytest.raises(BitstreamError):
                decoded(changed(data, **{key: value}))


def test_a_huge_grid_is_refused_before_it_is_made():
    data = encoded(make(n=40))
    refused(
        changed(data, grid_levels=32, grid_features=8, grid_log2=24, grid_growth=1.1, grid_coarsest=300),
        "may stand for",
    )
    refused(changed(data, grid_levels=32, grid_growth=4), "finest level")
    refused(changed(data, num_gaussians=(1 << 32) - 1), "may stand for")


def test_every_section_is_needed_whole():
    for values in FORMS.values():
        data = encoded(make(n=40), **values)
        for name in SECTIONS:
            content = dict(Parts.of(data).sections)[name]
            for less in (b"", content[:-1], content[: len(content) // 2], content + b"\0"):
                with pytest.raises(BitstreamError):
                    decoded(with_section(data, name, less))


def test_values_that_are_not_finite_are_refused():
    data = encoded(make(n=40))
    opacities = dict(Parts.of(data).sections)["opacities"]
    for low, step in ((np.nan, 0.1), (0.0, np.inf), (0.0, 0.0), (0.0, -1.0), (3e38, 3e38)):
        refused(with_section(data, "opacities", OPACITY.pack(low, step) + opacities[OPACITY.size :]), "opacities")
    grid = dict(Parts.of(data).sections)["grid"]
    for scale, zero in ((np.nan, 0), (0.0, 0), (1.0, 1 << 30), (1e38, 1 << 20)):
        refused(with_section(data, "grid", struct.pack("<fi", scale, zero) + grid[8:]), "grid")
    outside = decoded(with_section(data, "opacities", OPACITY.pack(-5.0, 1.0) + opacities[OPACITY.size :]))
    assert float(outside.opacities.min()) == 0
    assert float(outside.opacities.max()) == 1


def test_another_version_is_refused():
    parts = Parts.of(encoded(make(n=40)))
    parts.header["method_version"] = 2
    refused(parts.join(), "version 2")


@pytest.mark.parametrize("form", FORMS)
def test_hostile_files_are_refused_or_decode_in_bounds(form):
    data, mutator, tally = encoded(make(n=40), **FORMS[form]), Mutator(5), Tally()
    for i in range(150):
        hostile, kind = mutator.file([data])

        def decode(hostile=hostile) -> str:
            reader = ContainerReader(hostile)
            if reader.method != "compact3dgs":
                return "another method"
            Compact3DGS(PLUGINS, None).decode(reader)
            reader.finish()
            return "decoded"

        limit = 4 * decoded_limit(len(hostile)) + (8 << 20)
        attempt(decode, f"file {i} ({kind})", limit, tally, plugins_may_miss=kind.startswith("header"))
    assert tally.problems == []
    assert tally.outcomes["refused"] > 100


def test_it_is_decoded_by_its_name():
    data = encoded(make(n=40))
    assert decode_model(ContainerReader(data), PLUGINS).digest() == decoded(data).digest()

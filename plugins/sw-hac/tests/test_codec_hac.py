"""The file of HAC: exact integers on any machine, counted in full, and safe against strangers."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from forked_children import run_python
from hac_models import PLUGINS, decoded, encoded, generator, lattice_of, make, method, predictor
from hypothesis import given, settings
from hypothesis import strategies as st
from sw_anchors.attribute_sections import ExactNetwork
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.float_mode import this_machine
from sw_anchors.sections import morton_order
from sw_anchors.shape import GROUPS
from sw_anchors.testing import check_without_kernels
from sw_kit.forged_files import forged
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs import measure
from splatwizard_core.runs.session import Session
from splatwizard_core.scene.scene import Protocol
from sw_codecs.entropy.lattice import lattice
from sw_codecs.entropy.rows import RowContext, RowLattice
from sw_hac import codec
from sw_hac.method import HAC

RASTERIZER = ReferenceRasterizer()
SECTIONS = ["anchors", "masks", "grids", "networks", "features", "scalings", "offsets"]


def test_the_header_lists_what_decoding_needs():
    writer, made = ContainerWriter("hac", 1), method()
    with made.plugins.recording() as loaded:
        codec.encode(make(n=20), writer, made.config.codec.settings, made.plugins)
    assert {*((entry.kind, entry.name) for entry in loaded), *writer.required} == {
        ("coder", "octree"), ("entropy model", "bernoulli"), ("context model", "integer-mlp"),
        ("entropy model", "conditional-gaussian"),
    }  # fmt: skip


def test_a_file_has_a_section_for_everything():
    reader = ContainerReader(encoded(make()))
    assert sorted(reader.sections) == sorted(SECTIONS)
    assert reader.size == reader.header_bytes + sum(reader.sections.values())
    assert (reader.static["num_anchors"], reader.static["num_offsets"]) == (295, 4)


def test_the_decoder_has_the_encoders_integers_and_values():
    model = make()
    found, writer = lattice_of(model)
    result = decoded(writer.to_bytes())
    assert isinstance(result, DecodedAnchors)
    assert torch.equal(result.positions(), found.places.positions)
    assert torch.equal(result.masks, found.places.masks)
    assert result.counts() == {"num_anchors": 295, "num_gaussians": int(found.places.masks.sum())}
    for name, symbols, step in zip(GROUPS, found.symbols, found.steps, strict=True):
        expected = (symbols * step).to(torch.float32)
        assert torch.equal(getattr(result, name).flatten(1), expected)


def test_a_file_without_compiled_kernels_is_the_same_to_the_byte():
    check_without_kernels(lambda: encoded(make(n=60)), decoded)


def test_values_are_within_half_a_step_of_the_models():
    found, writer = lattice_of(make())
    result = decoded(writer.to_bytes())
    masks = found.places.masks.repeat_interleave(3, 1)
    for name, values, base in zip(("features", "scales", "offsets"), found.values, (1, 0.001, 0.2), strict=True):
        difference = (getattr(result, name).flatten(1) - values).abs()
        difference = difference * masks if name == "offsets" else difference
        assert float(difference.detach().max()) <= base * 1.0001  # steps are below twice the base
        assert float(difference.detach().max()) > 0


def test_the_file_renders_as_the_rounded_model():
    """The model rounds with float steps, the file with those of the table, up to an eighth in t apart."""
    model, cam = make(), front_camera()
    found, writer = lattice_of(model)
    result = decoded(writer.to_bytes())
    rounded = make()
    with torch.no_grad():
        rows = torch.nonzero(rounded.kept()).squeeze(1)
        order = morton_order(rounded.codes()[rows])
        values = [(s * q).to(torch.float32) for s, q in zip(found.symbols, found.steps, strict=True)]
        direct = DecodedAnchors(rounded.positions()[rows][order], values[0], values[2].view(-1, 4, 3), values[1],
                                found.places.masks, hidden=8)  # fmt: skip
        for name in rounded.NETWORKS:
            weights = {key: value.half().float() for key, value in getattr(rounded, name).state_dict().items()}
            getattr(direct, name).load_state_dict(weights)
        images = [
            RASTERIZER.render(m.gaussians(cam, RASTERIZER), cam, RasterOptions()).image for m in (result, direct, model)
        ]
    torch.testing.assert_close(images[0], images[1], atol=1e-6, rtol=0)
    assert float((images[0] - images[2]).abs().mean()) < 0.05


def test_another_process_decodes_the_same(tmp_path):
    paths = []
    for weights in ("float32", "float16"):
        paths.append(tmp_path / f"{weights}.swz")
        paths[-1].write_bytes(encoded(make(), codec__settings__weights=weights))
    code = (
        "import sys, torch\n"
        "from splatwizard_core.coding.container import ContainerReader\n"
        "from splatwizard_core.runs.decode import decode_model\n"
        "from splatwizard_core.plugins import load_plugins\n"
        "torch.set_num_threads(2)\n"
        "for path in sys.argv[1:]:\n"
        "    print(decode_model(ContainerReader.open(path), load_plugins()).digest())\n"
        "assert 'sympy' not in sys.modules  # torch imports it for meta tensors, in half a second\n"
    )
    found = run_python("-c", code, *map(str, paths), check=True)
    assert found.stdout.split() == [decoded(path.read_bytes()).digest() for path in paths]


def test_half_precision_weights_save_half_of_their_bytes():
    model = make()
    sizes = [
        ContainerReader(encoded(model, codec__settings__weights=w)).sections["networks"] for w in ("float32", "float16")
    ]
    assert sizes[0] == 2 * sizes[1]
    small = decoded(encoded(model, codec__settings__weights="float16"))
    assert torch.equal(small.mlp_color[0].weight, model.mlp_color[0].weight.half().float())


def test_the_bits_of_the_tables_are_the_size_of_the_file():
    found, writer = lattice_of(make(n=4000))
    size = sum(writer.sections[name] for name in codec.SECTIONS.values())
    assert 8 * size == pytest.approx(found.bits, rel=0.01)


def test_the_training_estimate_is_the_size_of_the_file():
    model = make(n=6000)
    _, writer = lattice_of(model)
    size = 8 * sum(writer.sections[name] for name in codec.SECTIONS.values())
    model.train()
    rows = torch.nonzero(model.kept()).squeeze(1)
    numbers = len(rows) * 26
    model.sample = 1.0
    with torch.no_grad():
        whole = model.attributes(rows).extras["rate"]
        assert whole.numbers == numbers
        assert float(whole.bits) * numbers == pytest.approx(size, rel=0.01)
        model.sample, model.noise = 0.05, generator(5)
        sampled = [float(model.attributes(rows).extras["rate"].bits) for _ in range(8)]
    assert sum(sampled) / 8 * numbers == pytest.approx(size, rel=0.03)


def test_exact_contexts_do_not_depend_on_the_batch_or_threads():
    model = make(n=700)
    predict = predictor(model)
    codes = model.codes()
    whole = predict(codes)
    for size in (1, 7, 600):
        part = codes[: 40 if size == 1 else None]
        blocks = [predict(block) for block in part.split(size)]
        for g in GROUPS:
            context, steps = whole[g]
            for field in ("centre", "number", "step"):
                joined = torch.cat([getattr(block[g][0], field) for block in blocks])
                assert torch.equal(joined, getattr(context, field)[: len(part)])
            assert torch.equal(torch.cat([block[g][1] for block in blocks]), steps[: len(part)])


def test_integers_predict_what_the_float_network_does():
    model = make(n=2000)
    network = ExactNetwork(model.mlp_grid, model.shape, model.base_steps)
    exact = network(model.codes(), model.grid.integer_features, model.grid.corners)
    floats = predictor(model, "float")(model.codes())
    for g, base in zip(GROUPS, (1.0, 0.001, 0.2), strict=True):
        for field in ("mean", "scale"):
            ours = np.asarray(getattr(exact[g], field)) / 4096 * base
            difference = np.abs(ours - np.asarray(getattr(floats[g][0], field))) / base
            # At the border of the box renormalising magnifies the rounding of coordinates.
            assert np.quantile(difference, 0.99) < 0.02
        ratio = network.steps(g, exact[g]) / floats[g][1]
        assert 0.85 < ratio.min() <= ratio.max() < 1.15  # steps of 1/8 in t


def test_contexts_on_the_lattice_are_those_of_the_networks_outputs():
    model = make(n=500)
    network = ExactNetwork(model.mlp_grid, model.shape, model.base_steps, step_offset=410)
    arguments = model.codes(), model.grid.integer_features, model.grid.corners
    found, plain = network.on_lattice(*arguments), network(*arguments)
    present = torch.rand(500, 86, generator=generator(0)) < 0.5
    for group, width in zip(GROUPS, model.shape.widths, strict=True):
        assert isinstance(found[group], RowLattice)
        assert torch.equal(found[group].step, plain[group].step)
        for there in (None, present[:, :width].numpy()):
            expected = lattice(plain[group].mean, plain[group].scale, plain[group].step, there)
            for ours, theirs in zip(found[group].present(there), expected, strict=True):
                assert np.array_equal(ours, theirs)


def test_a_mean_out_of_range_is_left_to_the_coder():
    model = make(n=50)
    with torch.no_grad():
        model.mlp_grid[2].bias[0] = 2.0**27
        model.mlp_grid[2].bias[-3] = -20  # the smallest step
    network = ExactNetwork(model.mlp_grid, model.shape, model.base_steps)
    found = network.on_lattice(model.codes(), model.grid.integer_features, model.grid.corners)
    assert isinstance(found["features"], RowContext)
    with pytest.raises(ValueError, match="a mean is beyond"):
        lattice(found["features"].mean, found["features"].scale, found["features"].step)


def test_rounding_the_context_costs_next_to_nothing():
    model = make(n=4000)
    sizes = {}
    for mode in ("exact", "float"):
        _, writer = lattice_of(model, mode=mode)
        sizes[mode] = sum(writer.sections[name] for name in codec.SECTIONS.values())
    assert sizes["exact"] == pytest.approx(sizes["float"], rel=0.02)


def test_an_anchor_without_gaussians_is_not_in_the_file():
    model = make(n=40)
    full = len(decoded(encoded(model)).anchors)
    with torch.no_grad():
        model.mask_logits[10] = -6
        model.mask_logits[11, 1:] = -6
        model.mask_logits[11, 0] = 1
    found = decoded(encoded(model))
    assert len(found.anchors) == full - 1
    assert not bool((found.anchors == model.positions()[10]).all(1).any())
    row = (found.anchors == model.positions()[11]).all(1).nonzero().item()
    assert found.masks[row].tolist() == [True, False, False, False]
    assert not bool(found.offsets[row, 1:].any())


def test_masked_offsets_cost_nothing():
    model = make(n=2000)
    before = ContainerReader(encoded(model)).sections
    with torch.no_grad():
        model.mask_logits[:, 2:] = -6
        model.mask_logits[:, 0] = 1
    after = ContainerReader(encoded(model)).sections
    assert after["offsets"] < 0.75 * before["offsets"]
    with torch.no_grad():
        model.offsets[:, 2:] *= 100
    assert ContainerReader(encoded(model)).sections["offsets"] == after["offsets"]


def test_outliers_come_back_clamped_about_the_mean():
    model = make(n=50)
    with torch.no_grad():
        model.features[10, 3] = 9000.0
        model.features[11, 3] = 1e5
    found, writer = lattice_of(model)
    result = decoded(writer.to_bytes())
    rows = [(result.anchors == model.positions()[i]).all(1).nonzero().item() for i in (10, 11)]
    assert float(result.features[rows[0], 3].detach()) == pytest.approx(9000, abs=2)
    # The other ends 15,000 steps from the mean of all numbers; its index is the largest there is.
    step = float(result.features[rows[1], 3].detach()) / float(found.symbols[0].max())
    mean = float(found.values[0].detach().double().mean())
    assert float(result.features[rows[1], 3].detach()) == pytest.approx(mean + 15_000 * step, abs=2)


@pytest.mark.parametrize("n", [0, 1, 6])
def test_few_anchors_make_a_file(n):
    model = make(n=n)
    result = decoded(encoded(model))
    assert result.num_rows == max(n - 5, 0)
    result.counts()
    cam = front_camera()
    with torch.no_grad():
        RASTERIZER.render(result.gaussians(cam, RASTERIZER), cam, RasterOptions())


def test_encoding_leaves_the_model_alone_and_repeats_itself():
    model = make()
    before = model.digest()
    assert encoded(model, codec__settings__weights="float16") == encoded(model, codec__settings__weights="float16")
    assert model.digest() == before


def test_float_mode_decodes_here_and_says_why_not_elsewhere():
    model = make()
    data = encoded(model, codec__settings__mode="float")
    assert torch.equal(decoded(data).positions(), decoded(encoded(model)).positions())
    reader = ContainerReader(data)
    assert reader.static["made_on"] == this_machine()
    for changed in ({"device": "cpu other", "torch": torch.__version__}, {"device": "x", "torch": "1.0"}, None):
        with pytest.raises(
            BitstreamError, match=r"mode 'float' decodes only where it was encoded.*codec.settings.mode=exact"
        ):
            decoded(forged(data, made_on=changed))


@pytest.mark.parametrize(("mode", "flags"), [("exact", []), ("float", ["device-bound"])])
def test_a_record_tells_that_a_file_is_bound_to_its_device(mode, flags, tmp_path):
    (tmp_path / "scene.swz").write_bytes(encoded(make(n=20), codec__settings__mode=mode))
    bound = measure.opener(tmp_path / "scene.swz", Session(PLUGINS, torch.device("cpu"), print))().device_bound
    scene, quality = SimpleNamespace(protocol=Protocol("test")), SimpleNamespace(metrics={})
    assert (
        measure._flags(scene, quality, SimpleNamespace(kind="cuda"), device_bound=bound, bad_rows=0, contended=False)
        == flags
    )


def test_a_weight_that_does_not_fit_half_precision_is_named():
    model = make(n=20)
    with torch.no_grad():
        model.mlp_color[0].weight[0, 0] = 1e6
    with pytest.raises(ValueError, match="float16"):
        encoded(model, codec__settings__weights="float16")


BLOCK = encoded(make(n=60))


@pytest.mark.parametrize("name", SECTIONS)
@settings(max_examples=25, deadline=None)
@given(place=st.integers(0, 2**32 - 1), value=st.integers(1, 255), how=st.sampled_from(["flip", "cut", "more"]))
def test_a_damaged_section_is_answered(name, place, value, how):
    section = bytearray(ContainerReader(BLOCK).section(name))
    at = place % len(section)
    if how == "cut":
        section = section[:at]
    elif how == "more":
        section += bytes([value])
    else:
        section[at] ^= value
    damaged = forged(BLOCK, {name: bytes(section)})
    try:
        found = decoded(damaged)
    except BitstreamError:
        return
    # Some bytes are plain numbers: bounds, weights of the networks that only draw. And the last bits of a stream may be
    # any: what they decode to is the same.
    assert name in ("anchors", "networks") or found.digest() == decoded(BLOCK).digest()
    assert how == "flip"
    assert all(bool(torch.isfinite(p).all()) for p in found.parameters())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("num_anchors", 2**32 - 1), ("num_anchors", -1), ("num_anchors", "many"), ("num_offsets", 65),
        ("num_offsets", 5), ("num_gaussians", 0), ("feature_dim", 0), ("feature_dim", 257), ("hidden", 9),
        ("hidden", 1.5), ("grid_hidden", 17), ("grid_features", 3), ("grid_space", []), ("grid_space", [2]),
        ("grid_space", [4096] * 32), ("grid_planes", [10, True]), ("grid_planes", None), ("grid_log2", [8]),
        ("grid_log2", [22, 22]), ("mode", "fast"),
        ("base_steps", [1, 1]), ("base_steps", [1, 0, 1]), ("base_steps", [1, "x", 1]),
        ("mode", "float"), ("weights", "float64"), ("weights", "float32"),
    ],
)  # fmt: skip
def test_header_values_of_a_stranger_are_refused(key, value):
    with pytest.raises(BitstreamError):
        decoded(forged(BLOCK, **{key: value}))


def test_a_grid_larger_than_the_file_may_stand_for_is_refused_before_it_is_made():
    with pytest.raises(BitstreamError, match="hash grid of"):
        decoded(forged(BLOCK, grid_space=[4096] * 32, grid_log2=[22, 22]))


def test_later_layouts_are_named():
    writer = ContainerWriter("hac", 2)
    with pytest.raises(BitstreamError, match="layout version 2 is unknown"):
        HAC(PLUGINS, None).decode(ContainerReader(writer.to_bytes()))


def test_the_header_is_plain_data():
    json.dumps(ContainerReader(BLOCK).static)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_model_on_a_gpu_makes_the_same_file():
    assert encoded(make().cuda()) == encoded(make())


def test_a_model_that_never_met_its_rate_is_encoded_with_a_warning(caplog):
    model = make(n=30)
    model.phase = "quantized training"
    assert decoded(encoded(model)).num_rows == 25
    assert "never trained for its rate" in caplog.text


class Lookups:
    """A hash grid that notes how many numbers each look-up gives."""

    def __init__(self, grid):
        self.grid, self.width, self.corners, self.numbers = grid, grid.width, grid.corners, []

    def integer_features(self, codes, dtype):
        self.numbers.append(len(codes) * max(self.width, self.corners))
        return self.grid.integer_features(codes, dtype)

    def __call__(self, x):
        self.numbers.append(len(x) * max(self.width, self.corners))
        return self.grid(x)


@pytest.mark.parametrize("mode", ["exact", "float"])
def test_a_wide_grid_is_looked_up_a_few_anchors_at_a_time(mode, monkeypatch):
    """65,536 anchors of a file of 5 kB took 3.5 GB: 2,048 features of each were there at once."""
    model = make(n=300)
    whole = predictor(model, mode)(model.codes())
    grid = Lookups(model.grid)
    limit = 20 * grid.corners
    for where, name in (
        ("sw_anchors.attribute_sections", "MAX_EXACT_NUMBERS"),
        ("sw_anchors.fast.exact_lattice", "MAX_EXACT_NUMBERS"),
        ("sw_hac.rate_model", "MAX_FLOAT_NUMBERS"),
    ):
        monkeypatch.setattr(f"{where}.{name}", limit)
    found = dataclasses.replace(model.rate_model, grid=grid).predictor(mode)(model.codes())
    assert 0 < max(grid.numbers) <= limit
    for group in GROUPS:
        for field in ("centre", "number", "step") if mode == "exact" else ("mean", "scale", "step"):
            ours, expected = (torch.as_tensor(getattr(each[group][0], field)) for each in (found, whole))
            assert torch.equal(ours, expected) if mode == "exact" else torch.allclose(ours, expected)

"""The file of HAC++: exact integers on any machine, counted in full, and safe against strangers."""

import json
import struct
from types import SimpleNamespace

import pytest
import torch
from hac_plus_models import PLUGINS, decoded, encoded, generator, make, method, recorded
from hypothesis import given, settings
from hypothesis import strategies as st
from sw_anchors.sections import BOUNDS_BYTES
from sw_anchors.shape import GROUPS
from sw_anchors.testing import check_without_kernels
from sw_compress.lambda_control import LeadToSize
from sw_kit.forged_files import forged
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.api import TaskLog
from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, SceneError
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene
from sw_hac_plus import codec, rate_model
from sw_hac_plus.method import HACPlus
from sw_hac_plus.voxel_lattice import kept_voxels

RASTERIZER = ReferenceRasterizer()
FEATURES = ["features.1", "features.2", "features.3"]
SECTIONS = ["anchors", "masks", "grids", "networks", *FEATURES, "scalings", "offsets"]
KINDS = ["full", "tiny", "none"]


def test_the_header_lists_what_decoding_needs():
    writer, made = ContainerWriter("hac-plus", 1), method()
    with torch.no_grad(), made.plugins.recording() as loaded:
        codec.encode(make(n=20), writer, made.config.codec.settings, made.plugins)
    assert {*((entry.kind, entry.name) for entry in loaded), *writer.required} == {
        ("coder", "octree"), ("entropy model", "bernoulli"), ("context model", "integer-mlp"),
        ("context model", "channel-mixture"), ("entropy model", "conditional-mixture"),
        ("entropy model", "conditional-gaussian"),
    }  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_the_decoder_has_the_encoders_integers_and_values(kind):
    model = make(channel__kind=kind)
    data = encoded(model)
    reader, result = ContainerReader(data), decoded(data)
    expected = {*SECTIONS, "features"} - set(FEATURES) if kind == "none" else set(SECTIONS)
    assert set(reader.sections) == expected
    recorder, geometry = recorded(model)
    assert torch.equal(result.positions(), geometry.positions)
    kept = torch.nonzero(model.kept()).squeeze(1)
    assert {tuple(p) for p in result.positions().tolist()} == {tuple(p) for p in model.positions()[kept].tolist()}
    assert torch.equal(result.masks, geometry.masks)
    assert result.counts() == model.counts()
    for name, blocks in recorder.found.items():
        assert torch.equal(getattr(result, name).flatten(1), torch.cat(blocks, dim=1))
    size = sum(reader.sections[name] for name in codec.sections(model.channel))
    assert 8 * (size - 40 * len(codec.sections(model.channel))) < recorder.bits < 8 * size


def test_a_file_without_compiled_kernels_is_the_same_to_the_byte():
    check_without_kernels(lambda: encoded(make(n=60)), decoded)


def test_values_are_within_half_a_step_of_the_models():
    model = make()
    result, (_, geometry) = decoded(encoded(model)), recorded(model)
    _, rows = kept_voxels(model)
    masks = geometry.masks.repeat_interleave(3, 1)
    for name, values, base in zip(GROUPS, model.raw(rows), model.base_steps, strict=True):
        difference = (getattr(result, name).flatten(1) - values).abs()
        difference = difference * masks if name == "offsets" else difference
        assert 0 < float(difference.detach().max()) <= base * 1.0001  # steps are below twice the base


def test_how_anchors_are_batched_is_no_matter(monkeypatch):
    """Blocks of rows are part of the format; what is computed at once is not."""
    data = encoded(make(n=100))
    monkeypatch.setattr("sw_anchors.attribute_sections.MAX_EXACT_NUMBERS", 500)
    monkeypatch.setattr("sw_codecs.entropy.conditional_mixture.AT_ONCE", 100)
    assert encoded(make(n=100)) == data
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert decoded(data).digest() == decoded(encoded(make(n=100))).digest()
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize(("mode", "limit"), [("exact", "MAX_EXACT_NUMBERS"), ("float", "MAX_FLOAT_NUMBERS")])
def test_channel_networks_are_evaluated_a_few_rows_at_a_time(mode, limit, monkeypatch):
    """A hidden layer of 512 for every anchor of a block would take gigabytes, whatever the size of the file."""
    model, seen = make(n=100), []
    whole, _ = recorded(model, mode)
    channel = model.channel if mode == "float" else model.channel.exact()
    plain = type(channel).slice

    def counted(self, index, known, context):
        seen.append(len(context) * model.channel.width(index))
        return plain(self, index, known, context)

    monkeypatch.setattr(type(channel), "slice", counted)
    monkeypatch.setattr(rate_model, limit, 600)
    found, _ = recorded(model, mode)
    assert len(seen) > len(FEATURES)
    assert max(seen) <= 600
    for group in GROUPS:
        assert torch.allclose(torch.cat(found.found[group], dim=1), torch.cat(whole.found[group], dim=1))


@pytest.mark.parametrize("kind", ["full", "tiny", "none"])
def test_the_rate_of_training_is_the_size_of_the_file(kind):
    """The rate model that training minimises, of the very values that the file holds."""
    model = make(n=6000, channel__kind=kind)
    recorder, _ = recorded(model)
    _, rows = kept_voxels(model)
    values = torch.cat([part for group in GROUPS for part in recorder.found[group]], dim=1)
    with torch.no_grad():
        forecast = model.rate_model.forecast(model.context_of(rows), slice(0, None))
        bits, _ = model.rate_model.rate(values, forecast, model.masks(rows), torch.ones(len(rows)))
    sections = ContainerReader(encoded(model)).sections
    size = 8 * sum(sections[name] for name in codec.sections(model.channel))
    assert float(bits) == pytest.approx(size, rel=0.02)


def test_decoding_leaves_the_global_generator_alone():
    data = encoded(make(n=20))
    before = torch.get_rng_state()
    decoded(data)
    assert torch.equal(torch.get_rng_state(), before)


def test_blocks_of_anchors_follow_one_another(monkeypatch):
    monkeypatch.setattr("sw_codecs.entropy.conditional.BLOCK_SYMBOLS", 12 * 40)
    model = make(n=200)
    result, (recorder, _) = decoded(encoded(model)), recorded(model)
    assert len(recorder.found["scales"]) == 5
    assert torch.equal(result.scales, torch.cat(recorder.found["scales"]))


@pytest.mark.parametrize("n", [0, 1, 6])
def test_few_anchors_make_a_file(n):
    result = decoded(encoded(make(n=n)))
    assert result.num_rows == max(n - 5, 0)
    with torch.no_grad():
        RASTERIZER.render(result.gaussians(front_camera(), RASTERIZER), front_camera(), RasterOptions())


def test_modes_cost_about_the_same_and_decode_to_about_the_same():
    model = make(n=1500)
    exact, floats = encoded(model), encoded(model, codec__settings__mode="float")
    sizes = [sum(ContainerReader(data).sections[name] for name in FEATURES) for data in (exact, floats)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.01)
    assert torch.equal(decoded(exact).positions(), decoded(floats).positions())
    # Steps of mode exact come from a table, an eighth apart in their logit.
    difference = (decoded(exact).features - decoded(floats).features).abs()
    assert float(difference.detach().mean()) < 0.5
    with pytest.raises(BitstreamError, match=r"mode 'float' decodes only where it was encoded"):
        decoded(forged(floats, made_on={"device": "x", "torch": "1.0"}))


def test_far_positions_come_back():
    """Integers on both sides of 0 and up to 21 bits an axis."""
    model = make(n=30)
    with torch.no_grad():
        model.anchors[10] = torch.tensor([-1.0, 0, 2]) * 2**19 * 0.01
        model.anchors[11] = torch.tensor([1.0, 0, 2]) * 2**19 * 0.01
        model.update_bounds()
    _, geometry = recorded(model)
    assert torch.equal(decoded(encoded(model)).positions(), geometry.positions)
    assert int(geometry.integers.max() - geometry.integers.min()) >= 1 << 20
    with torch.no_grad():
        model.anchors[11] *= 5
    with pytest.raises(ValueError, match=r"more than 2\^21 voxels of 0\.01: train with a larger voxel_size"):
        encoded(model)
    with torch.no_grad():
        model.anchors[11] = model.anchors[12]
    with pytest.raises(ValueError, match="share a voxel"):
        encoded(model)


@pytest.mark.parametrize("far", [30_000.0, 1e17])
def test_a_scene_that_no_file_could_hold_is_refused_before_it_is_trained(far):
    points = PointCloud(torch.tensor([[0.0, 0, 0], [1, 1, 1], [2, 0, 1], [far, 0, 0]]))
    with pytest.raises(SceneError, match=r"scene 'far': .* 2\^21 voxels of 0\.01: train with a larger voxel_size"):
        method(voxel_size=0.01).create_model(Scene("far", [], [], points, Protocol("test")), generator(0))


def test_encoding_leaves_the_model_alone_and_repeats_itself():
    model = make(n=50)
    before = model.digest()
    assert encoded(model, codec__settings__weights="float16") == encoded(model, codec__settings__weights="float16")
    assert model.digest() == before


BLOCK = encoded(make(n=40))


@settings(max_examples=60, deadline=None)
@given(
    name=st.sampled_from(SECTIONS), place=st.integers(0, 2**32 - 1), value=st.integers(1, 255),
    how=st.sampled_from(["flip", "cut", "more"]),
)  # fmt: skip
def test_a_damaged_section_is_answered(name, place, value, how):
    section = bytearray(ContainerReader(BLOCK).section(name))
    at = place % len(section)
    if how == "cut":
        section = section[:at]
    elif how == "more":
        section += bytes([value])
    else:
        section[at] ^= value
    try:
        found = decoded(forged(BLOCK, {name: bytes(section)}))
    except BitstreamError:
        return
    # Some bytes are plain numbers: bounds, voxel size, weights. And the last bits of a stream may be any.
    assert name in ("anchors", "networks") or found.digest() == decoded(BLOCK).digest()
    assert how == "flip"
    assert all(bool(torch.isfinite(p).all()) for p in found.parameters())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("num_anchors", 2**32 - 1), ("num_anchors", -1), ("num_offsets", 5), ("num_gaussians", 0), ("feature_dim", 9),
        ("feature_dim", 257), ("grid_hidden", 17), ("grid_space", [4096] * 32), ("base_steps", [1, 0, 1]),
        ("mode", "fast"), ("mode", "float"), ("channel", "huge"), ("channel", None), ("channel", "tiny"),
        ("channel", "none"), ("slices", [8]), ("slices", [4, 5]), ("slices", [-8, 16]), ("slices", "all"),
        ("channel_hidden", 7), ("channel_hidden", 513), ("weights", "float32"),
    ],
)  # fmt: skip
def test_header_values_of_a_stranger_are_refused(key, value):
    with pytest.raises(BitstreamError):
        decoded(forged(BLOCK, **{key: value}))


def test_a_voxel_size_that_makes_positions_infinite_is_refused():
    section = bytearray(ContainerReader(BLOCK).section("anchors"))
    section[BOUNDS_BYTES : BOUNDS_BYTES + 12] = struct.pack("<di", 9e29, (1 << 30) - 1000)
    with pytest.raises(BitstreamError, match="beyond all finite positions"):
        decoded(forged(BLOCK, {"anchors": bytes(section)}))


def test_networks_larger_than_the_file_may_stand_for_are_refused_before_they_are_made():
    values = {"feature_dim": 256, "num_offsets": 1, "channel.slices": [4] * 64, "channel.hidden": 1}
    data = encoded(make(n=6, **values))
    with pytest.raises(BitstreamError, match="channel networks of"):
        decoded(forged(data, channel_hidden=512))


def test_the_header_is_plain_data_and_later_layouts_are_named():
    json.dumps(ContainerReader(BLOCK).static)
    with pytest.raises(BitstreamError, match="layout version 2 is unknown"):
        HACPlus(PLUGINS, None).decode(ContainerReader(ContainerWriter("hac-plus", 2).to_bytes()))


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("kind", KINDS)
def test_a_model_on_a_gpu_makes_the_same_file(kind):
    assert encoded(make(channel__kind=kind).cuda()) == encoded(make(channel__kind=kind))


def test_the_order_of_the_models_anchors_is_no_matter():
    model, shuffled = make(n=40), make(n=40)
    order = torch.randperm(40, generator=generator(5))
    with torch.no_grad():
        for name in ("anchors", "features", "offsets", "log_scales", "mask_logits"):
            getattr(shuffled, name).copy_(getattr(model, name)[order])
    assert encoded(shuffled) == encoded(model)


@pytest.mark.parametrize("kind", ["full", "none"])
def test_a_file_of_a_size_decodes(kind):
    """Features keep their step where a network has learnt to read them in it."""
    model = make(n=2000, channel__kind=kind)
    size = int(0.95 * len(encoded(model, channel__kind=kind)))
    scene, config = SimpleNamespace(origin=(0, 0, 0)), method(channel__kind=kind).config
    LeadToSize(str(size), "hac-plus", 10, 20)(model, config, None, scene, None, 20, TaskLog())
    data = encoded(model, channel__kind=kind)
    assert 0.96 * size - 1_000 < len(data) <= size
    steps = ContainerReader(data).static["base_steps"]
    assert [a > b for a, b in zip(steps, model.base_steps, strict=True)] == [kind == "none", True, True]
    assert decoded(data).num_rows == int(model.kept().sum())

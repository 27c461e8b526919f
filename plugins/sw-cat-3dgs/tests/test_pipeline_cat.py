"""CAT-3DGS on the small procedural scene: it learns, resumes, and its file has the size that it estimates."""

import contextlib

import numpy as np
import pytest
import torch
from forked_children import run_python
from sw_anchors.coded_anchors import ENTROPY
from sw_kit.forged_files import forged
from sw_kit.short_training import file_of, psnr

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.streams import stream
from splatwizard_core.training.pipeline import TrainingStopped
from sw_cat_3dgs import codec
from sw_cat_3dgs.method import Cat3DGS
from sw_cat_3dgs.spatial_ar import plane_bits
from sw_cat_3dgs.triplane import GAIN
from sw_codecs.entropy import conditional
from sw_codecs.entropy.bernoulli import Bernoulli
from sw_codecs.quantizers.rounding import SteRound

pytestmark = pytest.mark.pipeline


def encoded(model, method, **values) -> bytes:
    return file_of(method(**values), model)


def decoded(data: bytes):
    with torch.no_grad():
        return Cat3DGS(load_plugins(), None).decode(ContainerReader(data, "test.swz"))


@pytest.fixture(scope="module")
def few(train):
    """A model of few anchors, whose file is decoded in a moment."""
    return train(iterations=70, lr__max_steps=70, growth__stop=0).model


def test_it_learns_and_the_file_renders_what_was_trained(scene, rasterizer, method, trained):
    start = method().create_model(scene, stream(0, "init"))
    best = psnr(trained.eval(), scene, rasterizer)
    assert best > psnr(start, scene, rasterizer) + 5
    assert trained.phase == ENTROPY
    model = decoded(encoded(trained, method))
    assert model.counts() == trained.counts()
    # Steps come from a table of 128 in the file: not quite those of training.
    assert psnr(model, scene, rasterizer) > best - 0.3


def test_stopping_changes_nothing(train, tmp_path):
    plan = {"iterations": 100, "lr__max_steps": 100}
    whole = train(**plan).model.digest()
    for stop in (65, 83):  # amid entropy training; while the spatial models train alone
        with pytest.raises(TrainingStopped):
            train(directory=tmp_path, stop_after=stop, **plan)
    assert train(directory=tmp_path, **plan).model.digest() == whole


@torch.no_grad()
def estimated_bits(model) -> dict[str, float]:
    """Bits of sections by the rate model that training minimises, of rounded values of all kept anchors."""
    rounded, model.context.rounded = model.context.rounded, True
    rows = torch.nonzero(model.kept()).squeeze(1)
    forecast, masks = model.rate_model.forecast(model.context_of(rows), slice(0, None)), model.masks(rows)
    groups = zip(model.raw(rows), forecast.steps.split(1, dim=1), model.centres(), strict=True)
    values = torch.cat([SteRound().forward(value, step, mean=centre) for value, step, centre in groups], dim=1)
    _, by_group = model.rate_model.rate(values, forecast, masks, torch.ones(len(rows)))
    planes = [torch.round(GAIN * plane) for plane in model.context.triplane.planes]
    model.context.rounded = rounded
    return {
        **dict(zip(("features", "scalings", "offsets"), by_group.tolist(), strict=True)),
        "triplane": float(plane_bits(model.context.spatial_models, planes)),
        "masks": float(Bernoulli().bits(masks.flatten()).sum()),
    }


@pytest.mark.parametrize("mode", ["exact", "float"])
def test_the_rate_of_training_is_the_size_of_the_file(method, trained, mode):
    reader = ContainerReader(encoded(trained, method, codec__settings__mode=mode), "test.swz")
    bits = estimated_bits(trained)
    framing = 60  # bytes of a section's first block; of the six streams of the triplane
    for name, estimate in bits.items():
        size = 8 * sum(v for k, v in reader.sections.items() if k.split(".")[0] == name)
        sections = sum(k.split(".")[0] == name for k in reader.sections)
        assert abs(size - estimate) < 0.02 * estimate + 8 * framing * sections, name
    total = 8 * sum(v for k, v in reader.sections.items() if k.split(".")[0] in bits)
    assert abs(total - sum(bits.values())) < 0.02 * total + 8 * framing * len(reader.sections)


def test_a_fresh_process_decodes_the_same_model(method, trained, tmp_path):
    path = tmp_path / "model.swz"
    path.write_bytes(encoded(trained, method))
    code = (
        "import torch, sys; torch.set_num_threads(2)\n"
        "from splatwizard_core.runs.decode import open_model\n"
        "from splatwizard_core.plugins import load_plugins\n"
        "print(open_model(sys.argv[1], load_plugins(), torch.device('cpu'))[0].digest())"
    )
    found = run_python("-c", code, str(path), check=True)
    assert found.stdout.split()[-1] == decoded(path.read_bytes()).digest()


def test_exact_symbols_do_not_depend_on_the_block(method, few, monkeypatch):
    """Blocks are part of the file; what is predicted for a row is not."""
    usual = decoded(encoded(few, method)).digest()
    for rows in (7, 64):
        assert few.num_rows > 2 * rows
        monkeypatch.setattr(conditional, "BLOCK_SYMBOLS", 12 * rows)
        assert decoded(encoded(few, method)).digest() == usual


@pytest.mark.parametrize(("mode", "threads"), [("exact", 2), ("float", 1)])
def test_only_floats_are_bound_to_one_thread(method, few, mode, threads, monkeypatch):
    seen, walk = [], codec.walk
    monkeypatch.setattr(codec, "walk", lambda *given: (seen.append(torch.get_num_threads()), walk(*given)))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        decoded(encoded(few, method, codec__settings__mode=mode))
    finally:
        torch.set_num_threads(before)
    assert seen == [threads] * 2


def test_float_files_hold_the_same_up_to_their_steps(scene, rasterizer, method, trained):
    exact, floats = (decoded(encoded(trained, method, codec__settings__mode=mode)) for mode in ("exact", "float"))
    assert torch.equal(exact.anchors, floats.anchors)
    assert torch.equal(exact.masks, floats.masks)
    assert abs(psnr(exact, scene, rasterizer) - psnr(floats, scene, rasterizer)) < 0.3
    assert (
        ContainerReader(encoded(trained, method, codec__settings__mode="float"), "x").static["made_on"]["torch"]
        == torch.__version__
    )


def test_half_precision_weights_halve_their_section(scene, rasterizer, method, trained):
    full, half = (
        ContainerReader(encoded(trained, method, codec__settings__weights=w), "x") for w in ("float32", "float16")
    )
    assert half.sections["networks"] * 2 == full.sections["networks"]
    model = Cat3DGS(load_plugins(), None).decode(half)
    assert psnr(model, scene, rasterizer) > psnr(trained.eval(), scene, rasterizer) - 0.5


def test_refined_scales_and_offsets_come_back(method, train):
    model = train(iterations=70, lr__max_steps=70, context__refine=True).model
    with torch.no_grad():
        for p in model.context.slices.parameters():
            p.add_(0.003)
    found = decoded(encoded(model, method, context__refine=True))
    assert found.counts() == model.counts()


def test_a_model_without_a_triplane_or_without_anchors_has_a_file(method, train, scene):
    early = train(iterations=30, lr__max_steps=30).model
    assert early.context.resolution == 0
    assert decoded(encoded(early, method)).num_rows == early.counts()["num_anchors"] > 0
    empty = method().create_model(scene, stream(0, "init"))
    with torch.no_grad():
        empty.mask_logits.fill_(-20.0)
    found = decoded(encoded(empty, method))
    assert found.counts() == {"num_anchors": 0, "num_gaussians": 0}


def test_a_heavier_rate_makes_a_smaller_file(method, train, trained, scene, rasterizer):
    sizes, quality = [], []
    for weight in (0.004, 0.2):
        model = (trained if weight == 0.004 else train(rate_term__lambda_=weight).model).eval()
        data = encoded(model, method, rate_term__lambda_=weight)
        sizes.append(len(data))
        quality.append(psnr(decoded(data), scene, rasterizer))
    assert sizes[0] > sizes[1]
    assert quality[0] > quality[1]


def test_a_heavy_weight_on_the_planes_shrinks_their_section(method, train):
    sizes = []
    for weight in (0.0, 3000.0):
        model = train(rate_term__triplane=weight, context__anchors_per_cell=16.0, iterations=120).model
        sizes.append(ContainerReader(encoded(model, method), "x").sections["triplane"])
    assert sizes[1] < 0.7 * sizes[0]


def test_damage_is_refused(method, few):
    """Sections changed at any place, with a container that agrees: an error with the section's name, or the same."""
    data = encoded(few, method)
    reader = ContainerReader(data, "x")
    good = decoded(data).digest()
    random = np.random.default_rng(0)

    assert decoded(forged(data)).digest() == good
    for name in reader.sections:
        payload = reader.section(name)
        with pytest.raises(BitstreamError):
            decoded(forged(data, {name: None}))
        with pytest.raises(BitstreamError):
            decoded(forged(data, {name: payload + b"\x00"}))
        for cut in random.integers(0, len(payload), 3):
            with pytest.raises(BitstreamError):
                decoded(forged(data, {name: payload[:cut]}))
        if name in ("networks", "frame", "anchors"):  # other numbers there are another model, where they are usable
            continue
        for at in random.integers(0, len(payload), 6):
            changed = bytearray(payload)
            changed[at] ^= 1 << random.integers(8)
            with contextlib.suppress(BitstreamError):
                assert decoded(forged(data, {name: bytes(changed)})).digest() == good
    hostile = {
        "feature_dim": 0, "slices": [1], "multiples": [], "channels": 513, "resolution": 1 << 13,
        "num_anchors": 1 << 30, "num_offsets": 65, "mode": "magic", "refine": 2, "hidden": "12",
        "context_hidden": 11, "weights": "float8", "base_steps": [1.0, 0.0, 0.2],
    }  # fmt: skip
    for key, value in hostile.items():
        with pytest.raises(BitstreamError):
            decoded(forged(data, **{key: value}))
    with pytest.raises(BitstreamError, match="too large for"):
        decoded(forged(data, resolution=250))
    for value in (np.nan, 1e38, 0.0):
        from splatwizard_core.coding.array_section import pack_array

        with pytest.raises(BitstreamError):
            decoded(forged(data, {"frame": pack_array(np.full((7, 3), value, "<f4"))}))
    weights = np.frombuffer(reader.section("networks"), "<f2").copy()
    weights[:] = np.inf
    with pytest.raises(BitstreamError):
        decoded(forged(data, {"networks": weights.tobytes()}))


@pytest.mark.cuda
def test_a_model_on_cuda_writes_a_file_that_the_cpu_decodes(method, trained):
    data = encoded(trained, method)
    on_gpu = encoded(trained.cuda(), method)
    trained.cpu()
    assert ContainerReader(on_gpu, "x").sections.keys() == ContainerReader(data, "x").sections.keys()
    assert decoded(on_gpu).counts() == decoded(data).counts()

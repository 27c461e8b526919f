"""The codec vectree: what comes back exactly, what is rounded, what is shared; and files that make no sense."""

import numpy as np
import pytest
import torch

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, SplatwizardError
from splatwizard_core.gaussians.model import GaussianModel
from sw_lightgaussian.stages import ScoredGaussians, truncated
from sw_lightgaussian.vectree import SECTIONS, VecTree, importance_of

QUICK = {"iterations": 30, "batch": 500}


def scored(make, n=300, degree=2, seed=0):
    model = truncated(make.cloud(n, 3, seed), degree)
    model.importance.copy_(torch.rand(n, generator=torch.Generator().manual_seed(seed)))
    return model


def written(plugins, model, **settings):
    writer = ContainerWriter("lightgaussian", 1)
    writer.static["codec"] = "vectree"
    plugins.gaussian_codecs.load("vectree")(plugins, **{**QUICK, **settings}).encode(model, writer)
    return writer


def decoded_from(plugins, reader):
    return plugins.gaussian_codecs.load("vectree")(plugins).decode(reader)


def reread(writer):
    return ContainerReader(writer.to_bytes(), "file.swz")


def rows(model, *names):
    """[N, ...] of several tensors side by side, in ascending order of the first column."""
    table = torch.cat([getattr(model, name).detach().reshape(model.num_rows, -1) for name in names], 1)
    return table[table[:, 0].argsort()]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_positions_are_exact_the_rest_is_rounded_and_colours_are_shared(plugins, make, degree):
    model = scored(make, degree=degree)
    decoded = decoded_from(plugins, reread(written(plugins, model)))
    assert (decoded.max_sh_degree, decoded.active_sh_degree) == (degree, degree)
    names = ("means", "opacity_logits", "log_scales", "quats")
    expected, found = rows(model, *names), rows(decoded, *names)
    assert torch.equal(found[:, :3], expected[:, :3])
    assert torch.equal(found[:, 3:], expected[:, 3:].half().float())
    # Colours: of the 40 % that matter most in float16, of the others a row of the codebook.
    keeps = decoded.code < 0
    assert int(keeps.sum()) == 120
    order = {tuple(m.tolist()): i for i, m in enumerate(model.means)}
    source = torch.tensor([order[tuple(m.tolist())] for m in decoded.means])
    assert float(model.importance[source[keeps]].min()) >= float(model.importance[source[~keeps]].max())
    dc, rest = model.sh_dc.detach()[source], model.sh_rest.detach()[source]
    assert torch.equal(decoded.sh_dc[keeps], dc[keeps].half().float())
    assert torch.equal(decoded.sh_rest[keeps], rest[keeps].half().float())
    red_green_blue = torch.cat(
        [decoded.sh_dc.detach().flatten(1), decoded.sh_rest.detach().transpose(1, 2).flatten(1)], 1
    )
    assert torch.equal(red_green_blue[~keeps], decoded.codebook[decoded.code[~keeps].long()])


def test_the_order_is_that_of_morton_codes(plugins, make):
    decoded = decoded_from(plugins, reread(written(plugins, scored(make))))
    means = decoded.means.detach().double()
    low, width = means.amin(0), means.amax(0) - means.amin(0)
    cells = ((means - low) / width * (2**21 - 1)).long().tolist()
    codes = [sum((p[a] >> i & 1) << (3 * i + a) for i in range(21) for a in range(3)) for p in cells]
    assert codes == sorted(codes)


def test_sections_and_their_sizes(plugins, make):
    n, writer = 2000, written(plugins, scored(make, 2000))
    assert set(writer.sections) == {"xyz", "attr", *SECTIONS.values()}
    size = reread(writer).size
    codes = 128  # 2^floor(log2(1200 / 4)) = 256 at most, here packed with what is used
    unpacked = n * (12 + 16 + 1 / 8) + 0.4 * n * 54 + 0.6 * n + 2 * codes * 54
    assert size < unpacked + 1000


def test_a_decoded_model_is_written_again_byte_for_byte(plugins, make):
    first = written(plugins, scored(make))
    decoded = decoded_from(plugins, reread(first))
    second = ContainerWriter("lightgaussian", 1)
    second.static["codec"] = "vectree"
    VecTree(plugins).encode_from_decoded(decoded, second)
    assert second.to_bytes() == first.to_bytes()
    with torch.no_grad():
        decoded.sh_dc[decoded.code >= 0] += 1
    with pytest.raises(ValueError, match="changed since"):
        VecTree(plugins).encode_from_decoded(decoded, ContainerWriter("lightgaussian", 1))


def test_all_sections_but_the_trained_ones_are_the_same_when_it_is_encoded_anew(plugins, make):
    first = written(plugins, scored(make))
    second = written(plugins, decoded_from(plugins, reread(first)))
    for name in ("xyz", "attr"):
        assert reread(second).section(name) == reread(first).section(name)


def test_encoding_is_repeatable_and_leaves_the_model_alone(plugins, make):
    model = scored(make)
    before = model.digest()
    assert written(plugins, model).to_bytes() == written(plugins, model).to_bytes()
    assert model.digest() == before


def test_without_scores_opacity_and_volume_rank(plugins, make):
    plain = make.cloud(200)
    found = importance_of(plain)
    expected = plain.opacities.double() * plain.log_scales.double().sum(1).mul(0.1).exp()
    assert np.argsort(found).tolist() == expected.detach().argsort().tolist()
    never_scored = ScoredGaussians(*(p.detach() for p in plain.parameters()))
    assert np.array_equal(importance_of(never_scored), found)
    decoded = decoded_from(plugins, reread(written(plugins, plain))).requires_grad_(False)
    assert float(decoded.opacities[decoded.code < 0].mean()) > float(decoded.opacities[decoded.code >= 0].mean())


@pytest.mark.parametrize("n", [0, 1, 2, 3])
@pytest.mark.parametrize("ratio", [0.0, 0.6, 1.0])
def test_a_handful_of_gaussians(plugins, make, n, ratio):
    decoded = decoded_from(plugins, reread(written(plugins, make.cloud(n), ratio=ratio)))
    assert decoded.num_rows == n
    assert all(bool(p.isfinite().all()) for p in decoded.parameters())


def test_the_picture_of_the_file_is_that_of_the_quantised_model_and_better_with_more_codes(
    plugins, rasterizer, toy, make
):
    def picture(model):
        camera = toy.scene.test[0].camera
        with torch.no_grad():
            return rasterizer.render(model.gaussians(camera, rasterizer), camera, make.options()).image

    def psnr(image):
        return float(-10 * (image - truth).square().mean().log10())

    model, truth, found = toy.truth, picture(toy.truth), []
    for size in (8, 32, 128):
        codec = VecTree(plugins, size=size, rows_per_code=1, **QUICK)
        writer = ContainerWriter("lightgaussian", 1)
        codec.encode(model, writer)
        found.append(psnr(picture(codec.decode(reread(writer)))))
    assert found[0] < found[1] + 0.1 < found[2] + 0.2
    assert found[2] > 25

    # The same numbers put together in memory, in the order in which the model came.
    colors = torch.cat([model.sh_dc.flatten(1), model.sh_rest.transpose(1, 2).flatten(1)], 1)
    order = torch.from_numpy(codec._order(model.means.numpy()))
    quantised = codec.vq.quantize(colors[order].numpy(), importance_of(model)[order], 0).vectors()
    shared = torch.empty_like(colors)
    shared[order] = torch.from_numpy(quantised)
    halves = (t.half().float() for t in (model.opacity_logits, model.log_scales, model.quats))
    in_memory = GaussianModel(
        model.means, shared[:, None, :3], shared[:, 3:].reshape(len(shared), 3, -1).transpose(1, 2), *halves
    )
    assert psnr(picture(in_memory)) == pytest.approx(found[2], abs=0.02)


@pytest.mark.parametrize(("name", "value"), [("sh_rest", float("nan")), ("means", float("inf"))])
def test_what_cannot_be_written_is_named(plugins, make, name, value):
    model = scored(make)
    with torch.no_grad():
        getattr(model, name)[3] = value
    with pytest.raises(SplatwizardError, match=f"'{name}' of 1 Gaussians is not finite"):
        written(plugins, model)


def test_an_opacity_of_one_is_an_infinite_logit_and_fits(plugins, make):
    model = scored(make)
    with torch.no_grad():
        model.opacity_logits[0] = torch.inf
    decoded = decoded_from(plugins, reread(written(plugins, model)))
    assert float(decoded.opacities.detach().max()) == 1


def with_static(writer, **values):
    writer.static.update(values)
    return reread(writer)


@pytest.mark.parametrize(
    "values",
    [{"num_gaussians": 299}, {"num_gaussians": 301}, {"num_gaussians": 2**32 - 1}, {"num_gaussians": -1},
     {"max_sh_degree": 1}, {"max_sh_degree": 4}, {"active_sh_degree": 3}, {"num_gaussians": "many"}],
)  # fmt: skip
def test_a_header_that_does_not_fit_its_sections_is_refused(plugins, make, values):
    with pytest.raises(BitstreamError):
        decoded_from(plugins, with_static(written(plugins, scored(make)), **values))


def test_a_flipped_byte_and_a_truncated_file_are_refused(plugins, make):
    data = written(plugins, scored(make)).to_bytes()
    for at in range(20, len(data), 997):
        flipped = bytearray(data)
        flipped[at] ^= 1
        with pytest.raises(BitstreamError):
            decoded_from(plugins, ContainerReader(bytes(flipped), "file.swz"))
    with pytest.raises(BitstreamError):
        ContainerReader(data[:-1], "file.swz")


@pytest.mark.parametrize("section", ["xyz", "attr", *SECTIONS.values()])
def test_a_section_that_is_missing_short_or_full_of_noise_is_blamed(plugins, make, section):
    whole = reread(written(plugins, scored(make)))
    noise = np.random.default_rng(0).integers(0, 256, 500, dtype=np.uint8).tobytes()
    for content in (None, b"", whole.section(section)[:-1], noise):
        writer = ContainerWriter("lightgaussian", 1)
        writer.static.update(whole.static)
        for name in whole.sections:
            if name != section:
                writer.add(name, whole.section(name))
            elif content is not None:
                writer.add(name, content)
        with pytest.raises(BitstreamError, match=section):
            decoded_from(plugins, reread(writer))


def test_values_that_are_not_finite_are_refused(plugins, make):
    whole = reread(written(plugins, scored(make)))
    planes = plugins.coders.load("byte-planes")()
    for section, array in (
        ("attr", np.full((300, 8), np.inf, np.float16)),
        ("sh_keep", np.full((120, 27), np.nan, np.float16)),
    ):
        writer = ContainerWriter("lightgaussian", 1)
        writer.static.update(whole.static)
        for name in whole.sections:
            writer.add(name, planes.encode(array) if name == section else whole.section(name))
        with pytest.raises(BitstreamError, match="finite"):
            decoded_from(plugins, reread(writer))


@pytest.mark.cuda
def test_a_model_on_a_gpu_is_written_and_read_on_a_cpu(plugins, make):
    model = scored(make).cuda()
    decoded = decoded_from(plugins, reread(written(plugins, model)))
    assert decoded.device.type == "cpu"
    assert torch.equal(rows(decoded, "means"), rows(model.cpu(), "means"))

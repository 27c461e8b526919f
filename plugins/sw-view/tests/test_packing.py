"""The bytes of the page: unpacked as page/data.js and the shader do, they are the Gaussians, to a known error."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
import pytest
import torch
from sw_gaussians.surfels import SurfelModel
from sw_view.packing import CHUNK, LEAST_STEP, morton_order, pack

from splatwizard_core.api import SH_C0, GaussianModel, SceneError, SplatModel


def gaussians(n: int, degree: int = 3, seed: int = 0) -> GaussianModel:
    draw = torch.Generator().manual_seed(seed)
    k = (degree + 1) ** 2
    model = GaussianModel.from_tensors(
        torch.randn(n, 3, generator=draw) * torch.tensor([1.0, 20.0, 300.0]),
        torch.randn(n, 1, 3, generator=draw),
        0.2 * torch.randn(n, k - 1, 3, generator=draw),
        torch.randn(n, generator=draw) + 1,
        torch.randn(n, 3, generator=draw) - 4,
        torch.randn(n, 4, generator=draw) * 5,
    )
    return model.requires_grad_(False)


def unpacked(text: str, facts: dict[str, Any]) -> dict[str, np.ndarray]:
    """The fields of the layout, as README and packing.py describe it."""
    data = zlib.decompress(base64.b64decode(text))
    n, at = facts["count"], 0

    def take(dtype: str, *shape: int) -> np.ndarray:
        nonlocal at
        found = np.frombuffer(data, dtype, int(np.prod(shape)), at).reshape(shape)
        at += found.nbytes
        return found.astype(np.float64) if dtype != "<u4" else found

    coefficients = (facts["degree"] + 1) ** 2 - 1
    bounds = take("<f4", -(-n // CHUNK), 6).repeat(CHUNK, axis=0)[:n]
    rotations, colors, scales = (take("<u4", n) for _ in range(3))
    places = np.stack([take("<u2", n) for _ in range(3)], axis=1) / 65535
    opacities = take("u1", n) / 255
    rest = take("u1", n, coefficients, 3) - 128
    assert at == len(data)
    for band, step in enumerate(facts["bands"], start=1):
        rest[:, band**2 - 1 : (band + 1) ** 2 - 1] *= step
    three = (np.stack([(rotations >> s) & 1023 for s in (20, 10, 0)], axis=1).astype(np.float64) - 511) / 511 / 2**0.5
    quats = np.empty((n, 4))
    for i in range(n):
        quats[i] = np.insert(three[i], int(rotations[i] >> 30), np.sqrt(max(0, 1 - (three[i] ** 2).sum())))
    low, step = facts["colors"]
    bits = np.stack([colors & 2047, (colors >> 11) & 2047, colors >> 22], axis=1) * np.array([1, 1, 2047 / 1023])
    return {
        "means": bounds[:, :3] + (bounds[:, 3:] - bounds[:, :3]) * places, "quats": quats, "opacities": opacities,
        "rest": rest, "colors": low + step * bits,
        "log_scales": facts["scales"][0]
        + facts["scales"][1] * np.stack([(scales >> s) & 1023 for s in (0, 10, 20)], axis=1),
    }  # fmt: skip


@pytest.mark.parametrize(("n", "degree"), [(1, 0), (255, 1), (257, 2), (700, 3)])
def test_what_is_unpacked_is_what_was_packed(n, degree):
    model = gaussians(n, degree)
    packed = pack(model)
    rows = morton_order(model.means.numpy())
    found = unpacked(packed.text, packed.facts)
    means = model.means.numpy()[rows]
    np.testing.assert_array_equal(packed.means, means)
    for start in range(0, n, CHUNK):  # half a step of its chunk, and float32 of the bounds
        chunk = slice(start, start + CHUNK)
        bound = np.ptp(means[chunk], axis=0) / 65535 / 2 + 1e-6 * np.abs(means[chunk]).max()
        assert (np.abs(found["means"][chunk] - means[chunk]) <= bound).all()
    half_steps = {
        "opacities": (torch.sigmoid(model.opacity_logits), 0.5 / 255),
        "log_scales": (model.log_scales, packed.facts["scales"][1] / 2),
        "colors": (0.5 + SH_C0 * model.sh_dc[:, 0], packed.facts["colors"][1] * 2047 / 1023 / 2),
        "rest": (model.sh_rest, max(packed.facts["bands"], default=0) / 2),
    }
    for name, (values, bound) in half_steps.items():
        np.testing.assert_allclose(found[name], values.numpy()[rows], atol=bound + 1e-6, rtol=0, err_msg=name)
    unit = torch.nn.functional.normalize(model.quats, dim=1).double().numpy()[rows]
    angle = 2 * np.degrees(np.arccos(np.clip(np.abs((unit * found["quats"]).sum(axis=1)), 0, 1)))
    assert angle.max() < 0.27  # smallest three of 10 bits: specs of interchange formats, 0.26 at worst


def test_what_nobody_would_see_is_left_out_and_bad_rows_too():
    model = gaussians(50, 1)
    with torch.no_grad():
        model.opacity_logits[3] = -6.0  # 0.0025
        model.means[7, 1] = torch.nan
        model.sh_rest[9, 0, 0] = torch.inf
    assert pack(model).facts["count"] == 47


def test_bands_that_are_not_drawn_are_not_packed():
    model = gaussians(20, 3)
    model.active_sh_degree = 1
    facts = pack(model).facts
    assert facts["degree"] == 1
    assert len(facts["bands"]) == 1


def test_a_step_finer_than_what_is_seen_is_not_taken():
    model = gaussians(20, 1)
    with torch.no_grad():
        model.sh_rest.mul_(1e-3)
    assert pack(model).facts["bands"] == [LEAST_STEP]


def test_surfels_are_packed_as_thin_ellipsoids():
    full = gaussians(20, 0)
    flat = SurfelModel.from_tensors(full.means, full.sh_dc, full.sh_rest, full.opacity_logits,
                                    full.log_scales[:, :2], full.quats)  # fmt: skip
    facts = pack(flat).facts
    assert facts["count"] == 20


def test_models_without_fixed_gaussians_are_refused_in_a_line():
    with pytest.raises(SceneError, match=r"no fixed Gaussians.*`sw view FILE --html PAGE.html`"):
        pack(SplatModel())


def test_nothing_to_show_is_an_error():
    with pytest.raises(SceneError, match="no Gaussian that could be drawn"):
        pack(gaussians(0))


def test_a_few_wild_gaussians_coarsen_no_others():
    model = gaussians(600, 1)
    with torch.no_grad():
        model.log_scales[5] = 30.0
        model.means[6] = 3e38
        model.sh_dc[7] = 1e6
        model.sh_rest[8] = -1e6
    packed = pack(model)
    assert packed.facts["count"] == 599
    found = unpacked(packed.text, packed.facts)
    rows = np.delete(np.arange(600), 6)
    rows = rows[morton_order(model.means.numpy()[rows])]
    tame = ~np.isin(rows, [5, 7, 8])
    truth = {
        "log_scales": (model.log_scales, 0.01), "rest": (model.sh_rest, 0.04), "means": (model.means, 0.02),
        "colors": (0.5 + SH_C0 * model.sh_dc[:, 0], 0.01),
    }  # fmt: skip
    for name, (values, bound) in truth.items():
        np.testing.assert_allclose(found[name][tame], values.numpy()[rows][tame], atol=bound, rtol=0, err_msg=name)
    assert found["log_scales"][rows == 5].min() > 4  # the huge one is as large as the others' range allows


def test_neighbours_in_morton_order_are_close():
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    steps = np.abs(np.diff(grid[morton_order(grid)], axis=0)).sum(axis=1)
    assert steps.mean() < 2.1  # row by row it is 1.98 with leaps of 14; a random order 7.9
    assert sorted(morton_order(grid)) == list(range(512))

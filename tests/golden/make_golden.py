"""Writes the golden files: small .swz files of each method and rate family, which every later version must decode.

    python tests/golden/make_golden.py

writes what is missing here and never what is there, and adds its facts to golden.json. A deliberate change of a format
keeps the old files and adds new ones under new names (`_v2`).
"""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sw_gaussians.surfels import Surface, SurfelModel

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.method import create_method
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import decode_model
from splatwizard_core.runs.encode import encode
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene

FOLDER = Path(__file__).resolve().parent
FACTS = FOLDER / "golden.json"


class Scattered:
    """Values by integer arithmetic alone: the same floats on every machine, with every library version."""

    drawn = 0

    def __call__(self, *shape: int) -> torch.Tensor:
        """Multiples of 1/2048 in -1 .. 1, their distribution a triangle."""
        i = np.arange(self.drawn, self.drawn + int(np.prod(shape)), dtype=np.uint64)
        self.drawn += len(i)
        mixed = i * np.uint64(2654435761) % np.uint64(2**32)
        mixed ^= (mixed * np.uint64(40503)) >> np.uint64(9)
        folded = (mixed & np.uint64(2047)).astype(np.int64) - ((mixed >> np.uint64(11)) & np.uint64(2047)).astype(
            np.int64
        )
        return torch.from_numpy((folded / 2048).astype(np.float32).reshape(shape))


def procedural(n: int, degree: int = 3, active: int | None = None) -> GaussianModel:
    """Gaussians of scattered values."""
    values = Scattered()
    coefficients = (degree + 1) ** 2
    return GaussianModel(
        4 * values(n, 3), values(n, 1, 3), values(n, coefficients - 1, 3) / 4, 4 * values(n) + 1, values(n, 3) - 4,
        values(n, 4), active_sh_degree=active,
    )  # fmt: skip


def surfels(n: int, degree: int = 3, active: int | None = None) -> SurfelModel:
    """Surfels of scattered values."""
    model = procedural(n, degree, active)
    tensors = {name: each.detach() for name, each in model.named_parameters()}
    tensors["log_scales"] = tensors["log_scales"][:, :2].contiguous()
    flat = SurfelModel(**tensors, active_sh_degree=active)
    flat.surface = Surface(1.0, 100.0, 0.05)
    return flat


def flat(n: int, degree: int = 3) -> GaussianModel:
    """Gaussians of scattered values, thin along their first axis."""
    model = procedural(n, degree)
    model.log_scales.data[:, 0] = math.log(1e-8)
    return model


def coincident() -> GaussianModel:
    """Forty Gaussians at five places."""
    model = procedural(40, 1)
    with torch.no_grad():
        model.means.copy_(model.means[torch.arange(40) % 5])
        model.opacity_logits.abs_()
    return model


def orderly() -> GaussianModel:
    """4,096 Gaussians on a lattice, most of them alike: enough for two classes of SH bands in few bytes."""
    i = torch.arange(4096)
    means = torch.stack([i % 16, i // 16 % 16, i // 256], dim=1).float()
    rest = torch.zeros(4096, 8, 3)
    rest[::37, :3] = 0.5
    rest[::37, 3:] = torch.tensor([0.25, -0.5, 1.0])
    quats = torch.zeros(4096, 4)
    quats[:, 0] = 1
    return GaussianModel(means, torch.zeros(4096, 1, 3), rest, torch.ones(4096), torch.full((4096, 3), -2.0), quats)


def tinted(n: int) -> GaussianModel:
    """Scattered Gaussians whose higher SH coefficients are multiples of a few."""
    model = procedural(n, 2)
    with torch.no_grad():
        strength, sides = Scattered()(n, 1), torch.arange(24) % 5 - 2.0
        model.sh_rest.copy_((strength * sides + model.sh_rest.flatten(1) / 16).unflatten(1, (8, 3)))
    return model


def graded() -> GaussianModel:
    """4,096 Gaussians at two places, of three sizes, in one colour that half of them have: two classes in few bytes."""
    model = orderly()
    i = torch.arange(4096)
    with torch.no_grad():
        model.means.copy_((i % 2)[:, None].expand(4096, 3))
        model.log_scales[i % 5 == 1] += 1.5
        model.log_scales[i % 7 == 2] -= 2
        model.sh_rest.copy_((i % 2)[:, None, None] * torch.tensor([0.25, -0.5, 1.0]).expand(8, 3))
    return model


def hac_anchors(settings: Mapping[str, Any]) -> SplatModel:
    """Forty anchors of HAC with scattered values and networks, a fifth of the offsets masked."""
    values = Scattered()
    points = PointCloud(4 * values(40, 3), 0.5 + values(40, 3) / 2)
    scene = Scene("scattered", [], [], points, Protocol("test"))
    model = create_method(load_plugins(), "hac", settings).create_model(scene, torch.Generator())
    with torch.no_grad():
        for _, parameter in sorted(model.named_parameters()):
            parameter.copy_(values(*parameter.shape))
        model.anchors.mul_(4)
        model.features.mul_(6)
        model.log_scales.sub_(4)
        model.mask_logits.copy_(torch.where(model.mask_logits > -0.4, 1.0, -9.0))
        model.update_bounds()
    return model


SMALL_HAC = {
    "voxel_size": 0.01, "num_offsets": 3, "feature_dim": 5, "hidden": 4, "grid.hidden": 6, "grid.features": 2,
    "grid.space": [6, 18], "grid.planes": [10, 40], "grid.log2_space": 7, "grid.log2_planes": 8,
    "codec.settings.weights": "float32",
}  # fmt: skip


def hac_plus_anchors(settings: Mapping[str, Any]) -> SplatModel:
    """Forty anchors of HAC++ with scattered values and networks, a fifth of the offsets masked."""
    values = Scattered()
    points = PointCloud(4 * values(40, 3), 0.5 + values(40, 3) / 2)
    scene = Scene("scattered", [], [], points, Protocol("test"))
    model = create_method(load_plugins(), "hac-plus", settings).create_model(scene, torch.Generator())
    with torch.no_grad():
        for name, parameter in sorted(model.named_parameters()):
            if name != "anchors":  # they lie on the lattice
                parameter.copy_(values(*parameter.shape))
        model.features.mul_(6)
        model.log_scales.sub_(4)
        model.mask_logits.copy_(torch.where(model.mask_logits > -0.4, 1.0, -9.0))
        model.update_bounds()
    return model


SMALL_HAC_PLUS = {**SMALL_HAC, "channel.slices": [2, 3], "channel.hidden": 4}
TINY_HAC_PLUS = {**SMALL_HAC_PLUS, "channel.kind": "tiny", "codec.settings.weights": "float16"}


def cat_anchors(settings: Mapping[str, Any]) -> SplatModel:
    """Nine anchors of CAT-3DGS with scattered values, planes and networks, a fifth of the offsets masked."""
    values = Scattered()
    points = PointCloud(4 * values(40, 3), 0.5 + values(40, 3) / 2)
    scene = Scene("scattered", [], [], points, Protocol("test"))
    model = create_method(load_plugins(), "cat-3dgs", settings).create_model(scene, torch.Generator())
    with torch.no_grad():
        for i, plane in enumerate(model.context.triplane.initial(3, torch.Generator())):
            setattr(model.context.triplane.planes, str(i), torch.nn.Parameter(torch.zeros_like(plane)))
        for name, parameter in sorted(model.named_parameters()):
            parameter.copy_(values(*parameter.shape) / (4 if name.startswith("context.arms") else 1))
        model.anchors.mul_(4)
        model.features.mul_(6)
        model.log_scales.sub_(4)
        model.mask_logits.copy_(torch.where(model.mask_logits > -0.4, 1.0, -9.0))
        model.mask_logits[9:] = -9.0
        model.update_bounds()
        turned = torch.tensor([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1.0]])
        sides = [torch.full((1, 3), side) for side in (0.0, 2.5, 0.125, 0.875)]
        model.context.frame = torch.cat([sides[0], turned, *sides[1:]])
    return model


SMALL_CAT = {
    "voxel_size": 0.01, "num_offsets": 3, "feature_dim": 5, "hidden": 4, "context.channels": 2, "context.hidden": 6,
    "context.slices": [2, 3], "context.slice_hidden": 3, "codec.weights": "float16",
    "context.refine": True,
}  # fmt: skip

SMALL_CODEBOOK = {"codec.vq_training": "kmeans", "codec.vq_iterations": 2}


def masked(n: int, on: int) -> GaussianModel:
    """Students of ChimeraGS, `on` of whose n masks are on, with an importance that falls along the rows."""
    from sw_chimerags.model import MaskedGaussians

    quantizer = load_plugins().quantizers.load("ste-mask")(0.01)
    model = MaskedGaussians.of(procedural(n), quantizer=quantizer, init=-6.0)
    with torch.no_grad():
        model.mask_logits[torch.arange(n) * 7 % max(n, 1) < on] = 1.0
    model.set_importance(torch.arange(n, 0, -1).float())
    return model


def sharing(n: int, colors: int, shapes: int, degree: int) -> GaussianModel:
    """Gaussians of C3DGS that share colours and shapes, on lattices whose steps are powers of two."""
    from sw_c3dgs.coded import CodedGaussians
    from sw_c3dgs.indexed import IndexedGaussians

    values = Scattered()
    means = (4 * values(n, 3)).half().numpy()
    sizes = {
        "opacity": (n,), "factor": (n,), "dc": (colors, 1, 3), "rest": (colors, (degree + 1) ** 2 - 1, 3),
        "shape": (shapes, 3), "quat": (shapes, 4),
    }  # fmt: skip
    symbols = {name: ((values(*size) + 1) * 127).numpy().astype(np.uint8) for name, size in sizes.items()}
    return IndexedGaussians(
        CodedGaussians(
            means,
            symbols,
            np.array([2**-8, 2**-4, 2**-6, 2**-8, 2**-8, 2**-7], np.float32),
            np.array([0, 190, 128, 127, 0, 128], np.int32),
            np.arange(n) * 5 % max(colors, 1),
            np.arange(n) * 3 % max(shapes, 1),
        )
    )


SMALL_COMPACT = {
    "grid.levels": 3, "grid.coarsest": 3, "grid.growth": 1.7, "grid.log2_size": 6, "network.hidden": 4, "rvq.size": 6,
    "rvq.stages": 3, "codec.settings.coder": "huffman",
}  # fmt: skip


def compact_gaussians(n: int, settings: Mapping[str, Any]) -> SplatModel:
    """n Gaussians of Compact3DGS in its last phase with scattered values; one more is masked."""
    values = Scattered()
    points = PointCloud(4 * values(n + 1, 3), 0.5 + values(n + 1, 3) / 2)
    scene = Scene("scattered", [], [], points, Protocol("test"))
    method = create_method(load_plugins(), "compact3dgs", settings)
    model = method.create_model(scene, torch.Generator())
    with torch.no_grad():
        for _, parameter in sorted(model.named_parameters()):
            parameter.copy_(values(*parameter.shape))
        model.means.mul_(4)
        # The largest and the smallest opacity are exactly 1 and 0 on every machine: they are in the file.
        model.opacity_logits.mul_(4)
        model.opacity_logits[:2] = torch.tensor([60.0, -200.0])[: n + 1]
        model.log_scales.sub_(1)
        model.mask_logits.fill_(1.0)
        model.mask_logits[n] = -9.0
    model.phase = "quantized"
    return model


def settled(n: int, degree: int = 3, anchor: str = "center") -> GaussianModel:
    """Gaussians of MesonGS on an octree of three levels, some voxels shared, in three blocks."""
    from sw_codecs.models.raht_gaussians import settled_copy
    from sw_codecs.models.raht_settings import RahtSettings

    settings = RahtSettings(depth=3, blocks=3, codebook_size=4, vq_training="kmeans", vq_steps=2, anchor=anchor)
    return settled_copy(procedural(n, degree), settings, seed=0)


def splats(n: int, context: str, subsets: int = 1) -> SplatModel:
    """n splats of Wisp with scattered numbers that are fixed, in cells of levels 3 to 6, some of them shared.

    context     "none", or "pyramid" with the large networks, or "small" with the small ones
    subsets     in so many of them, with one refinement, if there is more than one
    """
    from sw_wisp.appearance import AppearanceNetwork
    from sw_wisp.cube import Cube
    from sw_wisp.layers import Layers
    from sw_wisp.model import WispModel
    from sw_wisp.numbers import BASE_STEPS
    from sw_wisp.rate_model import PyramidRate, StaticRate
    from sw_wisp.rounding import FINAL

    values, steps = Scattered(), torch.tensor(BASE_STEPS)
    size = "small" if context == "small" else "large"
    rate: Any = StaticRate(steps) if context == "none" else PyramidRate(steps, adaptive=True, size=size)
    network = AppearanceNetwork(hidden=3, degree=1)
    with torch.no_grad():
        for _, parameter in [*sorted(network.named_parameters()), *sorted(rate.named_parameters())]:
            scattered = values(*parameter.shape)
            parameter.copy_(torch.where(scattered > 0.4, scattered / 8, 0))  # few weights, few bytes
    model = WispModel(
        values(n, 3), 3 * values(n), 2 * values(n, 5), values(n) - 2, values(n, 3), values(n, 12),
        3 + torch.arange(n) % 4, cube=Cube((-1.0, -1.0, -1.0), 2.0), network=network, rate=rate,
    )  # fmt: skip
    if subsets > 1:
        model.subsets = torch.arange(n) % subsets
        layers = Layers.of_subsets(subsets, 1)
        model.layers = replace(layers, swell=tuple(tuple(range(9, 9 + 2 * j)) for j in range(1, subsets)))
    model.begin_rate()
    model.phase = FINAL
    return model


def wide() -> GaussianModel:
    """Gaussians whose positions and opacities the ranges of gsc-quant would clip, two of them at one place."""
    model = procedural(9, 0)
    with torch.no_grad():
        model.means.mul_(64)
        model.means[7] = model.means[2]
        model.opacity_logits.mul_(8)
    return model


SMALL_VQ = {"vq.size": 4, "vq.iterations": 0}

Case = tuple[str, str, dict[str, Any], Callable[[], SplatModel]]
PRECISE = {"codec.settings.precision_power": 0.25, "codec.settings.sh_basis": True}

CASES: dict[str, Case] = {
    **{f"3dgs_{rate}_v1": ("3dgs", rate, {}, lambda: procedural(48)) for rate in ("r1", "r2", "r3", "r4", "r5")},
    "3dgs_exact_v1": ("3dgs", "r6", {}, lambda: procedural(16, 2, 1)),
    "3dgs_exact_empty_v1": ("3dgs", "r6", {}, lambda: procedural(0)),
    "3dgs_empty_v1": ("3dgs", "r3", {}, lambda: procedural(0)),
    "3dgs_one_v1": ("3dgs", "r4", {}, lambda: procedural(1, 0)),
    "3dgs_dull_v1": ("3dgs", "r5", {}, lambda: procedural(30, 3, 0)),
    "3dgs_coincident_v1": ("3dgs", "r3", {"codec.position_bits": 9}, coincident),
    "3dgs_classes_v1": ("3dgs", "r1", {"codec.position_bits": 8}, orderly),
    "3dgs_packets_v1": ("3dgs", "r3", {"codec.settings.prefixes": 4}, lambda: procedural(24, 1)),
    "3dgs_tiles_v1": (
        "3dgs",
        "r3",
        {
            "codec.name": "gaussians-tiles",
            "codec.settings.rows": 16,
            "codec.settings.coarsest": 10,
            "codec.settings.stand_ins": 10,
            "codec.settings.layers": 2,
        },
        lambda: procedural(30, 1),
    ),
    "3dgs_tiles_v2": (
        "3dgs",
        "r3",
        {
            "codec.name": "gaussians-tiles",
            "codec.settings.rows": 16,
            "codec.settings.coarsest": 10,
            "codec.settings.stand_ins": 10,
        },
        lambda: procedural(30, 1),
    ),
    "3dgs_precise_classes_v1": ("3dgs", "r1", {**PRECISE, "codec.position_bits": 8}, graded),
    "3dgs_precise_packets_v1": ("3dgs", "r1", {**PRECISE, "codec.settings.prefixes": 2}, lambda: tinted(96)),
    "pruned_3dgs_v1": ("pruned-3dgs", "r3", {}, lambda: procedural(5, 1)),
    "trimming_the_fat_ply_v1": ("trimming-the-fat", "r3", {"codec": "gaussians-ply"}, lambda: procedural(5, 1)),
    "trimming_the_fat_zstd_v1": ("trimming-the-fat", "r1", {"codec": "gaussians-zstd"}, lambda: procedural(24, 1, 0)),
    "flat_3dgs_v1": ("flat-3dgs", "r6", {}, lambda: flat(6, 1)),
    "trim_3dgs_median_v1": ("trim-3dgs", "r3", {}, lambda: flat(40, 1)),
    "trim_2dgs_v1": ("trim-2dgs", "r4", {}, lambda: surfels(30, 1)),
    "trim_2dgs_scratch_v1": ("trim-2dgs-scratch", "r6", {}, lambda: surfels(5, 1)),
    "pup_3dgs_exact_v1": ("pup-3dgs", "r3", {}, lambda: procedural(5, 1)),
    "pup_3dgs_quantized_v1": ("pup-3dgs", "r6", {"codec": "gaussians-quantized"}, lambda: procedural(12, 1)),
    "lightgaussian_v1": ("lightgaussian", "r3", SMALL_CODEBOOK, lambda: procedural(40, 2)),
    "lightgaussian_one_v1": ("lightgaussian", "r1", SMALL_CODEBOOK, lambda: procedural(1, 1)),
    "lightgaussian_empty_v1": ("lightgaussian", "r5", SMALL_CODEBOOK, lambda: procedural(0, 0)),
    "lightgaussian_ranged_v1": (
        "lightgaussian",
        "r3",
        {**SMALL_CODEBOOK, "codec.vq_ratio": 1.0, "codec.codebook_size": 2},
        orderly,
    ),
    **dict.fromkeys(("hac_exact_v1", "hac_exact_v2"), ("hac", "r4", SMALL_HAC, lambda: hac_anchors(SMALL_HAC))),
    **dict.fromkeys(
        ("hac_half_v1", "hac_half_v2"),
        ("hac", "r1", {**SMALL_HAC, "codec.settings.weights": "float16"}, lambda: hac_anchors(SMALL_HAC)),
    ),
    "hac_plus_v1": ("hac-plus", "r4", SMALL_HAC_PLUS, lambda: hac_plus_anchors(SMALL_HAC_PLUS)),
    "hac_plus_tiny_v1": ("hac-plus", "r1", TINY_HAC_PLUS, lambda: hac_plus_anchors(TINY_HAC_PLUS)),
    **dict.fromkeys(
        ("cat_3dgs_refined_v1", "cat_3dgs_refined_v2"), ("cat-3dgs", "r1", SMALL_CAT, lambda: cat_anchors(SMALL_CAT))
    ),
    "speedy_splat_v1": ("speedy-splat", "r3", {}, lambda: procedural(16, 2, 1)),
    "compact3dgs_v1": ("compact3dgs", "r5", SMALL_COMPACT, lambda: compact_gaussians(24, SMALL_COMPACT)),
    "compact3dgs_plain_v1": ("compact3dgs", "r7", SMALL_COMPACT, lambda: compact_gaussians(12, SMALL_COMPACT)),
    "compact3dgs_one_v1": (
        "compact3dgs",
        "r1",
        {**SMALL_COMPACT, "codec.settings.coder": "range", "codec.settings.grid_factor": 1},
        lambda: compact_gaussians(1, {**SMALL_COMPACT, "grid.halvings": 2}),
    ),
    "chimerags_v1": ("chimerags", "r2", SMALL_VQ, lambda: masked(32, 12)),
    "chimerags_uniform16_v1": ("chimerags", "r1", {**SMALL_VQ, "xyz": "uniform16"}, lambda: masked(20, 0)),
    "chimerags_float16_v1": ("chimerags", "r4", {**SMALL_VQ, "xyz": "float16", "prefer": []}, lambda: masked(5, 5)),
    "c3dgs_v1": ("c3dgs", "r4", {}, lambda: sharing(40, 7, 5, 2)),
    "c3dgs_planes_v1": ("c3dgs", "r1", {"codec.settings.arrays": "byte-planes"}, lambda: sharing(12, 12, 12, 3)),
    "c3dgs_empty_v1": ("c3dgs", "r4", {}, lambda: sharing(0, 0, 0, 0)),
    "chimerags_empty_v1": ("chimerags", "r3", SMALL_VQ, lambda: masked(0, 0)),
    "2dgs_exact_v1": ("2dgs", "r6", {}, lambda: surfels(16)),
    "2dgs_r3_v1": ("2dgs", "r3", {}, lambda: surfels(60, 2, 1)),
    "2dgs_zstd_v1": ("2dgs", "r6", {"codec.name": "gaussians-zstd"}, lambda: surfels(20, 1)),
    "2dgs_ply_v1": ("2dgs", "r6", {"codec.name": "gaussians-ply"}, lambda: surfels(8, 1, 0)),
    "2dgs_empty_v1": ("2dgs", "r1", {}, lambda: surfels(0)),
    "mesongs_v1": ("mesongs", "r4", {}, lambda: settled(60)),
    "mesongs_corner_v1": ("mesongs", "r1", {}, lambda: settled(20, 0, "corner")),
    "mesongs_one_v1": ("mesongs", "r2", {}, lambda: settled(1, 1)),
    "mesongs_empty_v1": ("mesongs", "r3", {}, lambda: settled(0)),
    "gsc_quant_v1": ("gsc-quant", "r5", {}, lambda: procedural(8, 2)),
    "gsc_quant_auto_v1": ("gsc-quant", "r2", {}, wide),
    "gsc_quant_empty_v1": ("gsc-quant", "r1", {}, lambda: procedural(0)),
    "wisp_v1": ("wisp", "r3", {}, lambda: splats(90, "pyramid")),
    "wisp_none_v1": ("wisp", "r5", {}, lambda: splats(90, "none")),
    "wisp_v2": ("wisp", "r3", {}, lambda: splats(90, "pyramid")),
    "wisp_none_v2": ("wisp", "r5", {}, lambda: splats(90, "none")),
    "wisp_packets_v2": ("wisp", "r3", {}, lambda: splats(60, "none", 3)),
}
"""File -> method, rate point, other values of its configuration, model."""

SUPERSEDED = {
    "hac_exact_v1": "hac_exact_v2",
    "hac_half_v1": "hac_half_v2",
    "cat_3dgs_refined_v1": "cat_3dgs_refined_v2",
    "wisp_v1": "wisp_v2",
    "wisp_none_v1": "wisp_none_v2",
}
"""Files whose layout is read, and no longer written -> the file of the same model that is."""

REORDERED = {"3dgs_tiles_v1"}
"""Files whose encoder has other packets today: they are read."""


def encoded(name: str) -> bytes:
    """The file as today's code writes it."""
    method_name, rate, values, model = CASES[name]
    plugins = load_plugins()
    rates = plugins.methods.load(method_name).RATES
    method = create_method(plugins, method_name, {**rates[rate], **values})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.swz"
        encode(method, model(), {"antialias": False}, path)
        return path.read_bytes()


def decoded_facts(data: bytes, name: str) -> dict[str, Any]:
    """What a file decodes to: SHA-256 over names, shapes and bytes of the parameters, and the state beside them."""
    model = decode_model(ContainerReader(data, name), load_plugins())
    if CASES[name][0] == "wisp":  # floats behind the integers of its file are not the same on every machine
        from sw_wisp.file import decode

        return {"parameters": decode(ContainerReader(data, name)).digest(), "rows": model.num_rows}
    sha = hashlib.sha256()
    for key, parameter in sorted(model.named_parameters()):
        sha.update(f"{key}{list(parameter.shape)}{parameter.dtype}".encode())
        sha.update(parameter.detach().numpy().tobytes())
    state = {name: getattr(model, name) for name in ("active_sh_degree",) if hasattr(model, name)}
    return {"parameters": sha.hexdigest(), "rows": model.num_rows, **state}


def main() -> None:
    facts = json.loads(FACTS.read_text()) if FACTS.exists() else {}
    for name in CASES:
        path = FOLDER / f"{name}.swz"
        if not path.exists():
            path.write_bytes(encoded(name))
            file = {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
            facts[name] = {**file, **decoded_facts(path.read_bytes(), name)}
            print(f"{name}: {file['bytes']:,} bytes, {facts[name]['rows']:,} rows")
    FACTS.write_text(json.dumps(facts, indent=2) + "\n")


if __name__ == "__main__":
    main()

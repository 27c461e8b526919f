"""Small models of HAC++ with scattered values, and their files."""

import copy

import torch
from sw_anchors.attribute_sections import AttributeEncoder
from sw_anchors.coded_anchors import ENTROPY
from sw_anchors.sections import round_networks
from sw_anchors.shape import GROUPS

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene
from sw_codecs.entropy.rows import RowMixture
from sw_hac_plus import codec
from sw_hac_plus.config import HACPlusConfig
from sw_hac_plus.method import HACPlus
from sw_hac_plus.model import HACPlusAnchors
from sw_hac_plus.voxel_lattice import kept_voxels

PLUGINS = load_plugins()
SMALL = {
    "voxel_size": 0.01, "feature_dim": 8, "num_offsets": 4, "hidden": 8, "bound_margin": "extent",
    "grid.hidden": 16, "grid.features": 2, "grid.space": [6, 10, 18], "grid.planes": [10, 34], "grid.log2_space": 8,
    "grid.log2_planes": 8, "channel.slices": [2, 3, 3], "channel.hidden": 6,
}  # fmt: skip


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def method(**values) -> HACPlus:
    overrides = {key.replace("__", "."): value for key, value in values.items()}
    return HACPlus(PLUGINS, apply_overrides(HACPlusConfig(), overrides, source="test"))


def published(**values) -> HACPlusAnchors:
    """The model with the authors' sizes, of 60 points."""
    points = PointCloud(torch.rand(60, 3, generator=generator(0)))
    return method(**values).create_model(Scene("points", [], [], points, Protocol("test")), generator(1))


def make(n: int = 300, *, seed: int = 0, **values) -> HACPlusAnchors:
    """n anchors in front of the test camera; a fifth of the offsets, and anchors 0 to 4, are masked."""
    g = generator(seed)
    points = torch.rand(max(n, 1), 3, generator=g) * 2 - torch.tensor([1.0, 1.0, -3.0])
    scene = Scene("points", [], [], PointCloud(points), Protocol("test"))
    model = method(**{**SMALL, **values}).create_model(scene, g)
    with torch.no_grad():
        for part in model.grid.grids:
            part.table.copy_(torch.randn(part.table.shape, generator=g))
        f, k = model.shape.features, model.num_offsets
        last = model.mlp_grid[2]
        parts = last.bias.split([f, f, 6, 6, 3 * k, 3 * k, 3, len(last.bias) - sum(model.shape.outputs)])
        # Deviations of some steps, all predicted scales positive, logits of both signs.
        for part, center, width in zip(parts, (0, 4, 0.08, 0.01, 0, 0.8, 0.2, 0), (3, 1, 0.02, 0.002, 0.5, 0.2, 0.3, 2),
                                       strict=True):  # fmt: skip
            part.copy_(center + width * (torch.rand(part.shape, generator=g) * 2 - 1))
        last.weight[2 * f : 2 * f + 12] *= 0.02
        model.features.copy_(4 * torch.randn(model.features.shape, generator=g))
        model.log_scales.copy_((0.08 + 0.02 * torch.rand(model.log_scales.shape, generator=g)).log())
        model.offsets.copy_(torch.randn(model.offsets.shape, generator=g))
        model.mask_logits[torch.rand(model.mask_logits.shape, generator=g) < 0.2] = -6
        model.mask_logits[:5] = -6
        if n == 0:
            model.mask_logits.fill_(-6)
    model.phase = ENTROPY
    return model.eval()


class Recorder(AttributeEncoder):
    """An encoder that keeps integers, steps and mixtures, and counts the bits of the tables."""

    def __init__(self, *args):
        super().__init__(*args)
        self.found, self.bits, self.mixed = {g: [] for g in GROUPS}, 0.0, []

    def code(self, block, context, step, present=None):
        symbols = super().code(block, context, step, present)
        self.found[block.group].append((symbols * step).to(torch.float32))
        mixed = isinstance(context, RowMixture)
        coder = self.further.get(type(context), self.coder)
        self.mixed += [(symbols, context)] if mixed else []
        self.bits += float(coder.bits(symbols, context, present).sum())
        return symbols


def recorded(model, mode="exact"):
    """Blocks that a walk over the model hands to its encoder, and the geometry."""
    model = copy.deepcopy(model)
    model.fold_units()
    round_networks(model.networks(), "float16")
    geometry, rows = kept_voxels(model)
    further = codec.mixtures(model.channel, mode, PLUGINS)
    recorder = Recorder(model, rows, codec.sections(model.channel), mode, PLUGINS, further)
    with torch.no_grad():
        codec.walk(recorder, model.rate_model.predictor(mode), model.channel, geometry)
    return recorder, geometry


def encoded(model: HACPlusAnchors, **values) -> bytes:
    writer = ContainerWriter("hac-plus", HACPlus.version)
    with torch.no_grad():
        method(**values).encode(model, writer)
    return writer.to_bytes()


def decoded(data: bytes):
    with torch.no_grad():
        return HACPlus(PLUGINS, None).decode(ContainerReader(data))

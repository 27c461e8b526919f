"""Small models of Compact3DGS with scattered values, as a trained one has them."""

import torch
from sw_compact3dgs.colors import ColorField
from sw_compact3dgs.config import Compact3DGSConfig
from sw_compact3dgs.method import Compact3DGS
from sw_compact3dgs.model import QUANTIZED, CompactGaussians
from sw_gaussians.volume_mask import VolumeMaskedGaussians

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import apply_overrides

PLUGINS = load_plugins()
FIELD = {"levels": 4, "features": 2, "coarsest": 4, "growth": 1.7, "log2_size": 6, "hidden": 8}


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def method(**values) -> Compact3DGS:
    overrides = {key.replace("__", "."): value for key, value in values.items()}
    return Compact3DGS(PLUGINS, apply_overrides(Compact3DGSConfig(), overrides, source="test"))


def field(seed: int = 0, **values) -> ColorField:
    return ColorField(**{**FIELD, **values}, generator=generator(seed))


def make(n: int = 300, *, seed: int = 0, size: int = 16, stages: int = 3, off: int = 5, **values) -> CompactGaussians:
    """n Gaussians in front of the test camera, in the last phase; the first `off` are masked."""
    g = generator(seed)
    model = CompactGaussians(
        torch.rand(n, 3, generator=g) * 2 - torch.tensor([1.0, 1.0, -3.0]), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3),
        torch.randn(n, generator=g), torch.randn(n, 3, generator=g) * 0.3 - 3, torch.randn(n, 4, generator=g),
        color=field(seed, **values), quantizer=PLUGINS.quantizers.load("ste-mask")(0.01), init=1.0, size=size,
        stages=stages,
    )  # fmt: skip
    with torch.no_grad():
        table = model.color.grid.table
        table.copy_(torch.randn(table.shape, generator=g))
        model.mask_logits[:off] = -6
    model.fit_codebooks(3)
    assert model.phase == QUANTIZED
    assert isinstance(model, VolumeMaskedGaussians)
    return model.eval()


def written(model: CompactGaussians, **values) -> ContainerWriter:
    writer = ContainerWriter("compact3dgs", Compact3DGS.version)
    with torch.no_grad():
        method(**values).encode(model, writer)
    return writer


def encoded(model: CompactGaussians, **values) -> bytes:
    return written(model, **values).to_bytes()


def decoded(data: bytes):
    with torch.no_grad():
        return Compact3DGS(PLUGINS, None).decode(ContainerReader(data)).requires_grad_(False)

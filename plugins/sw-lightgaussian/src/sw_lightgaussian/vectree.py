"""Codec `vectree` for whole Gaussian models: positions without loss, colours by `importance-vq`, the rest in float16.

Source: LightGaussian (arXiv 2311.17245). Sections (docs/bitstream.md): `xyz`, `attr`, and the parts of `importance-vq`.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.finetune.volume import volume_factor
from sw_gaussians.surfels import refuse_surfels
from torch import Tensor

from splatwizard_core.api import BitstreamError, GaussianModel, SplatwizardError
from sw_codecs.models.exchangeable import array_coder
from sw_codecs.positions.ordering import box_cells
from sw_lightgaussian.importance_vq import HALF_MAX, CodedVectors, ImportanceVQ, PartError, VQSettings

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager

log = logging.getLogger(__name__)

SECTIONS = {"header": "vq", "mask": "mask", "indices": "index", "codebook": "codebook", "own": "sh_keep"}
"""Part of `importance-vq` -> section."""

ATTRIBUTES = 8  # opacity logit, three log scales, four components of the quaternion


class CodedGaussians(GaussianModel):
    """Decoded Gaussians with the codes of their colours: `encode_from_decoded` writes it again without training.

    code        [N] int32 buffer: entry of the codebook, -1 for a Gaussian with colours of its own
    codebook    [K, D] float32 buffer
    """

    ROWS = (*GaussianModel.ROWS, "code")

    code: Tensor
    codebook: Tensor

    def __init__(self, *tensors: Tensor, active_sh_degree: int, code: Tensor, codebook: Tensor) -> None:
        super().__init__(*tensors, active_sh_degree=active_sh_degree)
        self.register_buffer("code", code)
        self.register_buffer("codebook", codebook)


class VecTree:
    """Settings: those of `importance-vq`; `seed` is of its codebook's training."""

    Settings = VQSettings

    def __init__(self, plugins: PluginManager, *, seed: int = 0, **settings: Any) -> None:
        self.plugins, self.seed = plugins, seed
        self.vq = ImportanceVQ(plugins, **settings)

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        """Sections of `model`; what its buffer `importance` [N] ranks lowest shares a codebook.

        Without that buffer opacity x volume^0.1 ranks. Raises SplatwizardError for a NaN, or for means that are not
        finite.
        """
        arrays = _arrays(model)
        order = self._order(arrays["means"])
        colors = _colors(arrays["sh_dc"], arrays["sh_rest"])[order]
        self.vq.device = model.device  # where a codebook of millions of colours is trained in minutes, if that is a GPU
        coded = self.vq.quantize(colors, importance_of(model)[order], self.seed)
        self._write(model, arrays, order, coded, writer)

    def encode_from_decoded(self, model: CodedGaussians, writer: ContainerWriter) -> None:
        """The same sections that a decoded, unchanged `model` came from, byte for byte: nothing is trained again.

        Raises ValueError if its colours are no longer those of its codes.
        """
        arrays = _arrays(model)
        order = self._order(arrays["means"])
        colors = _colors(arrays["sh_dc"], arrays["sh_rest"])[order]
        codes = model.code.cpu().numpy().astype(np.int64)[order]
        codebook = model.codebook.cpu().numpy()
        coded = CodedVectors(codes, codebook.astype(np.float16), colors[codes < 0].astype(np.float16))
        if not np.array_equal(coded.vectors(), colors):
            raise ValueError("the colours were changed since they were decoded: encode the model anew")
        self._write(model, arrays, order, coded, writer)

    def decode(self, reader: ContainerReader) -> CodedGaussians:
        """The model. Raises BitstreamError."""
        n = reader.integer("num_gaussians", low=0, high=2**32 - 1)
        degree = reader.integer("max_sh_degree", low=0, high=3)
        active = reader.integer("active_sh_degree", low=0, high=degree)
        reader.allow(_decoded_bytes(n, degree), f"a model of {n:,} Gaussians")
        planes = array_coder(reader, self.plugins, "arrays", "byte-planes")
        with reader.decoding("xyz") as data:
            means = _finite(self.plugins.coders.load("float-delta")().decode(data, np.float32, (n, 3)))
        with reader.decoding("attr") as data:
            attributes = _finite(planes.decode(data, np.float16, (n, ATTRIBUTES))).astype(np.float32)
        bands = (degree + 1) ** 2
        coded = self._coded(reader, n, 3 * bands)
        colors = coded.vectors()
        dc, rest = colors[:, None, :3], colors[:, 3:].reshape(n, 3, bands - 1).transpose(0, 2, 1)
        tensors = (means, dc, rest, attributes[:, 0], attributes[:, 1:4], attributes[:, 4:])
        return CodedGaussians(
            *(torch.from_numpy(np.require(t, requirements=["C", "W"])) for t in tensors),
            active_sh_degree=active,
            code=torch.from_numpy(coded.codes.astype(np.int32)),
            codebook=torch.from_numpy(coded.codebook.astype(np.float32)),
        )

    def _coded(self, reader: ContainerReader, n: int, d: int) -> CodedVectors:
        """The colours; what is wrong with a part is blamed on its section."""
        parts = {part: reader.section(section) for part, section in SECTIONS.items()}
        try:
            return self.vq.unpack(parts, n, d)
        except PartError as error:
            with reader.decoding(SECTIONS[error.part]):
                raise BitstreamError(error.reason) from error
        raise AssertionError  # not reached

    def _order(self, means: NDArray[np.float32]) -> NDArray[np.int64]:
        """Indices [N] that bring the Gaussians into Morton order; no picture depends on it."""
        found: NDArray[np.int64] = self.plugins.coders.load("float-delta").sort(box_cells(means))
        return found

    def _write(
        self,
        model: GaussianModel,
        arrays: dict[str, NDArray[np.float32]],
        order: NDArray[np.int64],
        coded: CodedVectors,
        writer: ContainerWriter,
    ) -> None:
        writer.raster["sh_degree"] = model.max_sh_degree
        writer.static["num_gaussians"] = model.num_rows
        writer.static["max_sh_degree"] = model.max_sh_degree
        writer.static["active_sh_degree"] = model.active_sh_degree
        if self.vq.arrays != "byte-planes":
            writer.static["arrays"] = self.vq.arrays
        load = self.plugins.coders.load
        writer.add("xyz", load("float-delta")().encode(arrays["means"][order]))
        parts = self.vq.pack(coded)
        for part, section in SECTIONS.items():
            writer.add(section, parts[part])
        attributes = np.concatenate([arrays["opacity_logits"][:, None], arrays["log_scales"], arrays["quats"]], 1)
        halves = np.clip(attributes, -HALF_MAX, HALF_MAX).astype(np.float16)
        writer.add("attr", load(self.vq.arrays)().encode(halves[order]))
        n = model.num_rows
        writer.allow(_decoded_bytes(n, model.max_sh_degree), f"a model of {n:,} Gaussians")


@torch.no_grad()
def importance_of(model: GaussianModel) -> NDArray[np.float64]:
    """[N]: the buffer `importance` of the model if it has one that was computed, else opacity x volume^0.1."""
    found = getattr(model, "importance", None)
    if isinstance(found, Tensor) and found.shape == (model.num_rows,) and bool((found > 0).any()):
        return found.double().cpu().numpy()
    log.info("the model has no importance scores: opacity x volume^0.1 takes their place")
    return (model.opacities.double() * volume_factor(model.log_scales.double(), 0.1)).cpu().numpy()


def _arrays(model: GaussianModel) -> dict[str, NDArray[np.float32]]:
    """The six tensors on the host. Raises SplatwizardError for what cannot be written."""
    refuse_surfels(model, "codec vectree")
    arrays = {}
    for name in model.RAW:
        arrays[name] = array = getattr(model, name).detach().float().cpu().numpy()
        # float16 clamps infinities; positions are kept as they are.
        bad = ~np.isfinite(array) if name == "means" else np.isnan(array)
        if bad.any():
            rows = int(bad.reshape(len(array), -1).any(1).sum())
            raise SplatwizardError(f"'{name}' of {rows:,} Gaussians is not finite: they cannot be encoded")
    return arrays


def _colors(dc: NDArray[np.float32], rest: NDArray[np.float32]) -> NDArray[np.float32]:
    """[N, 3K]: band 0, then the other coefficients of red, of green, of blue."""
    n = len(dc)
    return np.concatenate([dc.reshape(n, 3), rest.transpose(0, 2, 1).reshape(n, 3 * rest.shape[1])], 1)


def _finite(array: NDArray[Any]) -> NDArray[Any]:
    if not np.isfinite(array).all():
        raise BitstreamError("holds values that are not finite")
    return array


def _decoded_bytes(n: int, degree: int) -> int:
    """Of the model in float32: 164 a Gaussian at SH degree 2."""
    return 4 * n * (11 + 3 * (degree + 1) ** 2)

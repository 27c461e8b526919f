"""Entries of this package: quantizers, entropy and context models, coders, codecs of Gaussians."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatwizard_core.api import Registry, hookimpl

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatwizard_core import api
    from sw_codecs.arrays import byte_planes, deflate, packed_bits
    from sw_codecs.coders import arithmetic, huffman
    from sw_codecs.context import integer_mlp
    from sw_codecs.entropy import (
        bernoulli,
        categorical,
        columns,
        conditional,
        conditional_mixture,
        gaussian_exact,
    )
    from sw_codecs.models import codecs, raht_codec
    from sw_codecs.positions import octree
    from sw_codecs.quantizers import (
        binary,
        fake_quant,
        residual_quantizer,
        rounding,
        uniform,
        vector_quantizer,
    )
    from sw_codecs.vectors import residual_vq, sensitivity_vq

    # mypy holds each class that is registered below to its contract.
    QUANTIZERS: list[Callable[..., api.Quantizer]] = [
        uniform.Uniform, rounding.SteRound, binary.SteBinary, binary.SteMask,
        fake_quant.FakeQuantAffine, vector_quantizer.VectorQuantizer, residual_quantizer.ResidualVectorQuantizer,
    ]  # fmt: skip
    ENTROPY_MODELS: list[Callable[..., api.EntropyModel]] = [
        columns.Columns, categorical.Categorical, bernoulli.Bernoulli, gaussian_exact.GaussianExact,
        conditional.ConditionalGaussian, conditional_mixture.ConditionalMixture,
    ]  # fmt: skip
    CONTEXT_MODELS: list[Callable[..., api.ContextModel]] = [
        integer_mlp.IntegerMlp,
    ]  # fmt: skip
    ENTROPY_CODERS: list[Callable[..., api.EntropyCoder]] = [
        arithmetic.RangeCoder, arithmetic.RansCoder, huffman.HuffmanCoder,
    ]  # fmt: skip
    POSITION_CODECS: list[Callable[..., api.PositionCodec]] = [octree.Octree]
    ARRAY_CODERS: list[Callable[..., api.ArrayCoder]] = [
        byte_planes.BytePlanes, byte_planes.FloatDelta, packed_bits.PackedBits, deflate.Deflate,
    ]  # fmt: skip
    VECTOR_CODERS: list[Callable[..., api.VectorCoder]] = [residual_vq.ResidualVQ, sensitivity_vq.SensitivityVQ]
    GAUSSIAN_CODECS: list[Callable[..., api.GaussianCodec]] = [
        codecs.Exact, codecs.Quantized, codecs.Ply, codecs.Lossless, raht_codec.Raht,
    ]  # fmt: skip


@hookimpl
def register_quantizers(registry: Registry[Any]) -> None:
    registry.add("uniform", "sw_codecs.quantizers.uniform:Uniform",
                 summary="affine, bits and range per channel; rounding or noise")  # fmt: skip
    registry.add("ste-round", "sw_codecs.quantizers.rounding:SteRound",
                 summary="multiples of a step, straight-through gradient")  # fmt: skip
    registry.add("ste-binary", "sw_codecs.quantizers.binary:SteBinary", summary="the sign, +1 or -1")
    registry.add("ste-mask", "sw_codecs.quantizers.binary:SteMask", summary="a learned mask with a threshold")
    registry.add("fake-quant", "sw_codecs.quantizers.fake_quant:FakeQuantAffine",
                 summary="affine with a zero point, range observed in training")  # fmt: skip
    registry.add("vq", "sw_codecs.quantizers.vector_quantizer:VectorQuantizer",
                 summary="nearest codebook entry; k-means or weighted batches, bounded memory")  # fmt: skip
    registry.add("residual-vq", "sw_codecs.quantizers.residual_quantizer:ResidualVectorQuantizer",
                 summary="a sum of entries, a codebook for each stage")  # fmt: skip


@hookimpl
def register_entropy_models(registry: Registry[Any]) -> None:
    registry.add("columns", "sw_codecs.entropy.columns:Columns",
                 summary="integer matrix, stored statistics per column, any alphabet")  # fmt: skip
    registry.add("categorical", "sw_codecs.entropy.categorical:Categorical",
                 summary="stored counts, one table per context")  # fmt: skip
    registry.add("bernoulli", "sw_codecs.entropy.bernoulli:Bernoulli", summary="masks, stored share of ones")
    registry.add("gaussian-exact", "sw_codecs.entropy.gaussian_exact:GaussianExact",
                 summary="mean and scale per symbol, integers only: decodes on any machine")  # fmt: skip
    registry.add("conditional-gaussian", "sw_codecs.entropy.conditional:ConditionalGaussian",
                 summary="blocks of rows with a predicted mean, scale and step; exact or float",
                 native="sw_codecs.exact_native:EXACT")  # fmt: skip
    registry.add("conditional-mixture", "sw_codecs.entropy.conditional_mixture:ConditionalMixture",
                 summary="the same with two predicted Gaussians and their weights")  # fmt: skip


@hookimpl
def register_context_models(registry: Registry[Any]) -> None:
    registry.add("integer-mlp", "sw_codecs.context.integer_mlp:IntegerMlp",
                 summary="ReLU network evaluated in exact integer arithmetic")  # fmt: skip


@hookimpl
def register_coders(registry: Registry[Any]) -> None:
    registry.add("range", "sw_codecs.coders.arithmetic:RangeCoder", codes="symbols",
                 summary="arithmetic coding under a ModelSpec")  # fmt: skip
    registry.add("rans", "sw_codecs.coders.arithmetic:RansCoder", codes="symbols", summary="rANS under a ModelSpec")
    registry.add("huffman", "sw_codecs.coders.huffman:HuffmanCoder", codes="symbols",
                 summary="Huffman codes from count tables", native="sw_codecs.native:CODECS")  # fmt: skip
    registry.add("octree", "sw_codecs.positions.octree:Octree", codes="positions",
                 summary="point positions as octree occupancy")  # fmt: skip
    registry.add("byte-planes", "sw_codecs.arrays.byte_planes:BytePlanes", codes="arrays",
                 summary="float or integer arrays without loss: byte planes, zstd")  # fmt: skip
    registry.add("float-delta", "sw_codecs.arrays.byte_planes:FloatDelta", codes="arrays",
                 summary="float32 positions without loss: steps as byte planes, zstd")  # fmt: skip
    registry.add("packed-bits", "sw_codecs.arrays.packed_bits:PackedBits", codes="arrays",
                 summary="indices of 1 to 16 bits, packed")  # fmt: skip
    registry.add("deflate", "sw_codecs.arrays.deflate:Deflate", codes="arrays",
                 summary="float or integer arrays without loss: one DEFLATE stream")  # fmt: skip
    registry.add("sensitivity-vq", "sw_codecs.vectors.sensitivity_vq:SensitivityVQ", codes="vectors",
                 summary="float vectors: a codebook for the least sensitive, own entries for the rest")  # fmt: skip
    registry.add("residual-vq", "sw_codecs.vectors.residual_vq:ResidualVQ", codes="vectors",
                 summary="vectors as sums of codebook entries, indices Huffman coded or packed")  # fmt: skip
    registry.add("gaussians-exact", "sw_codecs.models.codecs:Exact", codes="gaussians", stores="float32",
                 summary="whole Gaussian models, float32 as trained")  # fmt: skip
    registry.add("gaussians-quantized", "sw_codecs.models.codecs:Quantized", codes="gaussians", prefixes="prefixes=8",
                 summary="whole Gaussian models on a lattice, octree positions, range coded")  # fmt: skip
    registry.add("gaussians-ply", "sw_codecs.models.codecs:Ply", codes="gaussians", stores="float32",
                 summary="whole Gaussian models, the .ply of 3DGS bit for bit")  # fmt: skip
    registry.add("gaussians-zstd", "sw_codecs.models.codecs:Lossless", codes="gaussians",
                 summary="whole Gaussian models, float32 as trained, packed without loss")  # fmt: skip
    registry.add("raht", "sw_codecs.models.raht_codec:Raht", codes="gaussians",
                 summary="whole Gaussian models: RAHT over an octree, a codebook for SH bands")  # fmt: skip

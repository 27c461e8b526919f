"""Registers the methods spz, sog, splat and compressed-ply, and codecs of the same names for any other method."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("spz", "sw_formats.methods:Spz", title="SPZ",
                 summary="a trained 3DGS scene as .spz (Niantic)",
                 presets=["paper", "quick"], rates=["r1", "r2", "r3"])  # fmt: skip
    registry.add("sog", "sw_formats.methods:Sog", title="SOG",
                 summary="a trained 3DGS scene as .sog (PlayCanvas)",
                 presets=["paper", "quick"], rates=["r1", "r2", "r3"])  # fmt: skip
    registry.add("splat", "sw_formats.methods:Splat", summary="a trained 3DGS scene as .splat (antimatter15)",
                 presets=["paper", "quick"], rates=["r1"])  # fmt: skip
    registry.add("compressed-ply", "sw_formats.methods:CompressedPly", title="compressed PLY",
                 summary="a trained 3DGS scene as compressed .ply (PlayCanvas)",
                 presets=["paper", "quick"], rates=["r1"])  # fmt: skip


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("spz", "sw_formats.codecs:SpzCodec", codes="gaussians",
                 summary="the bytes of a .spz: quantised, gzip or zstd")  # fmt: skip
    registry.add("sog", "sw_formats.codecs:SogCodec", codes="gaussians",
                 summary="the bytes of a .sog: codebooks and a palette, WebP")  # fmt: skip
    registry.add("splat", "sw_formats.codecs:SplatCodec", codes="gaussians",
                 summary="the bytes of a .splat: 32 a Gaussian, no SH")  # fmt: skip
    registry.add("compressed-ply", "sw_formats.codecs:CompressedPlyCodec", codes="gaussians",
                 summary="the bytes of a compressed .ply: quantised in chunks of 256")  # fmt: skip

"""What this package provides."""

from splatwizard_core.plugins import Registry, hookimpl


@hookimpl
def register_quantizers(registry: Registry) -> None:
    registry.add(
        "uniform", "sw_codecs.uniform:Uniform", summary="affine, bits and range per channel; noise or rounding"
    )


@hookimpl
def register_entropy_models(registry: Registry) -> None:
    registry.add("columns", "sw_codecs.columns:Columns",
                 summary="integer matrix, stored statistics per column, any alphabet")  # fmt: skip


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("range", "sw_codecs.coders:RangeCoder", summary="arithmetic coding under a ModelSpec")
    registry.add("rans", "sw_codecs.coders:RansCoder", summary="rANS under a ModelSpec")
    registry.add("octree", "sw_codecs.octree:Octree", summary="point positions as octree occupancy")

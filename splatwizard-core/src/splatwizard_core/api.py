"""The face of the core for methods, rasterizers, codecs, metrics and data sets: at most 80 names, stable since 0.2.

`api.pyi` lists them, docs/plugins.md describes each. Everything else in `splatwizard_core` may change with any release.
"""

from splatwizard_native import lazy_exports

OLDER = {
    "splatwizard_core.gaussians.inputs": "rgb_to_dc", "splatwizard_core.gaussians.placement": "origin_of world_shift",
}  # fmt: skip
"""Names of 0.2 that go with 0.4."""

__all__, __getattr__ = lazy_exports(__name__, OLDER)

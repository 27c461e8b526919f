"""Native modules: compiled kernels, found prebuilt, in the cache, or compiled on first use."""

from splatwizard_core.native.build import BuildRow, build_all
from splatwizard_core.native.loader import NativeModule, cache_root

__all__ = ["BuildRow", "NativeModule", "build_all", "cache_root"]

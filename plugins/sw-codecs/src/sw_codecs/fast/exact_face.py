"""Operations of the exact mode as their header has them; exact_operations.py makes room for what they write."""

from __future__ import annotations

from splatwizard_native import operations
from sw_codecs.exact_native import EXACT as MODULE

__getattr__ = operations(MODULE, __name__)

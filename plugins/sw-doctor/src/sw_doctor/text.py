"""Texts of findings: one line of bounded length, sizes in GB."""

from __future__ import annotations

SLOWLY = "slowly: the pure-torch reference draws, some hundred times slower than compiled kernels"
OF = " of "
"""Between the name of a step and the distribution whose code it runs."""


def one_line(text: object, limit: int = 300) -> str:
    """Text of a stranger (an exception, a compiler) as one line of bounded length."""
    words = " ".join(str(text).split())
    return words if len(words) <= limit else f"{words[:limit]} ..."


def gigabytes(size: float) -> str:
    """`1.5 GB`; two digits below ten, which are what matters when space runs out."""
    amount = size / 1e9
    return f"{amount:.2f} GB" if amount < 10 else f"{amount:,.0f} GB"

"""Splits views into train and test by rules over their names' order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TypeVar

from splatwizard_core.api import SceneError

T = TypeVar("T")

RULES = (
    "'every<n>' (every n-th is a test view), 'lod:<k>', 'all', 'file' where the scene brings its own, "
    "or a file of names"
)
RULE = re.compile(r"(every|lod:)(\d{1,9})")


def is_rule(split: str) -> bool:
    """Whether a split is one of the rules, and no file of names."""
    return split in ("all", "file") or RULE.fullmatch(split) is not None


def split_views(views: Sequence[T], rule: str) -> tuple[list[T], list[T]]:
    """Split views that are already sorted by name into (train, test).

    every<n>    index % n == 0 is tested, the rest is trained; n >= 2
    lod:<k>     k < 50: indices 0..k are tested, the others trained; k >= 50: 0..k trained, the rest tested
                (BungeeNeRF, as Scaffold-GS, HAC and CAT-3DGS run it)
    all         everything is trained and everything is tested

    Raises SceneError for an unknown rule, and if either half would be empty.
    """
    views = list(views)
    if rule == "all":
        if not views:
            raise SceneError("split 'all' needs at least 1 view, got 0")
        return views, list(views)
    match = RULE.fullmatch(rule)
    if match is None:
        if "/" in rule or rule.lower().endswith((".txt", ".json")):
            raise SceneError(f"split: {rule}: there is no such file of names")
        raise SceneError(f"unknown split '{rule}': use {RULES}")
    n = int(match[2])
    if match[1] == "every":
        if n < 2:
            raise SceneError(f"split '{rule}' leaves nothing to train on: n must be at least 2")
        tested = [i % n == 0 for i in range(len(views))]
    else:
        tested = [(i <= n) == (n < 50) for i in range(len(views))]
    test = [view for view, is_test in zip(views, tested, strict=True) if is_test]
    train = [view for view, is_test in zip(views, tested, strict=True) if not is_test]
    if not train or not test:
        raise SceneError(
            f"split '{rule}' of {len(views)} view{'s' * (len(views) != 1)} gives {len(train)} to train and "
            f"{len(test)} to test: both need at least 1 (at least 2 views in all); add views or use split 'all'"
        )
    return train, test

"""Splits views into train and test by rules over their names' order, or over where their cameras stand."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TypeVar

from splatwizard_core.api import SceneError, View
from splatwizard_core.tooling import several
from sw_datasets.sectors import sector_of

T = TypeVar("T")

RULES = (
    "'every<n>' (every n-th is a test view), 'lod:<k>', 'sparse:<n>', 'block:<k>of<n>', 'sector:<deg>', "
    "'sector:<deg>@<start>', 'all', 'file' where the scene brings its own, or a file of names"
)
INDEX_RULE = re.compile(r"(every|lod:|sparse:)(\d{1,9})|(block:)(\d{1,9})of(\d{1,9})")
SECTOR_RULE = re.compile(r"sector:(\d{1,3})(?:@(\d{1,3}))?")
OWN = "file+"
"""Begins a rule that is used on the halves of a scene's own split, each by itself: `file+sparse:9`."""
SPARSE_TEST = 8  # sparse:<n> tests what every8 tests
MOST_TESTED = 1000  # views of a sector; of more, every few
HELD_OUT = ("sparse:", "sector:", "block:")
"""Rules that hold out places, so that start points which only the held-out photographs gave would leak them."""


def is_rule(split: str) -> bool:
    """Whether a split is one of the rules, and no file of names."""
    bare = split.removeprefix(OWN)
    return split in ("all", "file") or any(rule.fullmatch(bare) for rule in (INDEX_RULE, SECTOR_RULE))


def holds_out_places(split: str) -> bool:
    """Whether start points of a scene that is split so come from the training views alone, unless asked otherwise."""
    return split.removeprefix(OWN).startswith(HELD_OUT)


def split_scene(
    views: Sequence[View], rule: str, own: tuple[Sequence[View], Sequence[View]] | None = None
) -> tuple[list[View], list[View], str]:
    """Split a scene's views, sorted by name, into (train, test, the rule as ids have it).

    own     (train, test) of the scene's own files: of these, `sparse` thins the first half, `sector` takes its sector
            out of the first and leaves only it of the second; ids say `file+sparse:<n>`

    A start that `sector` chose stands in the rule that is returned. Raises SceneError as `split_views` does, and for
    cameras that do not stand about a place.
    """
    bare = rule.removeprefix(OWN)
    parts = None if own is None or not own[0] or not own[1] else [sorted(half, key=_name) for half in own]
    by_halves = parts is not None and bare.startswith(("sparse:", "sector:"))
    if rule != bare and not by_halves:
        raise SceneError(f"split '{rule}': the scene brings no split of its own, or '{bare}' does not use it")
    prefix = OWN if by_halves else ""
    if (sector := SECTOR_RULE.fullmatch(bare)) is not None:
        source, tested = parts if parts is not None else (list(views), list(views))
        degrees, start = int(sector[1]), None if sector[2] is None else int(sector[2])
        inside = sector_of([v.camera for v in source], [v.camera for v in tested], degrees, start)
        train = [view for view, held in zip(source, inside.of_source, strict=True) if not held]
        test = [view for view, held in zip(tested, inside.of_tested, strict=True) if held]
        _check_halves(bare, len(views), train, test)
        step = -(-len(test) // MOST_TESTED)
        return train, test[::step], f"{prefix}sector:{degrees}@{inside.start}"
    if parts is not None and by_halves:
        return [parts[0][i] for i in sparse_indices(len(parts[0]), bare)], parts[1], prefix + bare
    return *split_views(views, bare), bare


def split_views(views: Sequence[T], rule: str) -> tuple[list[T], list[T]]:
    """Split views that are already sorted by name into (train, test).

    every<n>    index % n == 0 is tested, the rest is trained; n >= 2
    lod:<k>     k < 50: indices 0..k are tested, the others trained; k >= 50: 0..k trained, the rest tested
                (BungeeNeRF, as Scaffold-GS, HAC and CAT-3DGS run it)
    sparse:<n>  index % 8 == 0 is tested; n of the others, evenly spaced, are trained
    block:<k>of<n>      run k (from 0) of n consecutive ones is tested, the others are trained; n >= 2
    all         everything is trained and everything is tested

    Raises SceneError for an unknown rule, and if either half would be empty.
    """
    views = list(views)
    if rule == "all":
        if not views:
            raise SceneError("split 'all' needs at least 1 view, got 0")
        return views, list(views)
    match = INDEX_RULE.fullmatch(rule)
    if match is None:
        if "/" in rule or rule.lower().endswith((".txt", ".json")):
            raise SceneError(f"split: {rule}: there is no such file of names")
        raise SceneError(f"unknown split '{rule}': use {RULES}")
    kind, count = match[1] or match[3], len(views)
    if kind == "block:":
        k, n = int(match[4]), int(match[5])
        if not (n >= 2 and k < n):
            raise SceneError(f"split '{rule}': use block:<k>of<n> with n of at least 2 and k from 0 to n - 1")
        tested = [k * count // n <= i < (k + 1) * count // n for i in range(count)]
    else:
        n = int(match[2])
        if kind == "every" and n < 2:
            raise SceneError(f"split '{rule}' leaves nothing to train on: n must be at least 2")
        every = SPARSE_TEST if kind == "sparse:" else n
        tested = [(i <= n) == (n < 50) if kind == "lod:" else i % every == 0 for i in range(count)]
    test = [view for view, is_test in zip(views, tested, strict=True) if is_test]
    train = [view for view, is_test in zip(views, tested, strict=True) if not is_test]
    if kind == "sparse:":
        train = [train[i] for i in sparse_indices(len(train), rule)]
    _check_halves(rule, count, train, test)
    return train, test


def sparse_indices(count: int, rule: str) -> list[int]:
    """Indices of the n of `count` views that `sparse:<n>` trains on: evenly spaced, the first and the last among them.

    Raises SceneError unless 1 <= n <= count.
    """
    n = int(rule.partition(":")[2])
    if not 1 <= n <= count:
        raise SceneError(f"split '{rule}': there are {count} views to choose from; give 1 to {count}")
    if n == 1:
        return [(count - 1) // 2]
    return [(2 * j * (count - 1) + n - 1) // (2 * (n - 1)) for j in range(n)]  # floor(j (count - 1) / (n - 1) + 1/2)


def _check_halves(rule: str, count: int, train: Sequence[object], test: Sequence[object]) -> None:
    if not train or not test:
        raise SceneError(
            f"split '{rule}' of {several(count, 'view')} gives {len(train)} to train and "
            f"{len(test)} to test: both need at least 1 (at least 2 views in all); add views or use split 'all'"
        )


def _name(view: View) -> str:
    return view.name

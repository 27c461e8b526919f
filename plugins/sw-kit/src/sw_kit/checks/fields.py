"""Fields that an entry of each kind may declare, and what is legal in them."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from sw_report.published_files import DECLARED

from splatwizard_core.tooling import MetricInfo
from sw_kit.finding import hold

if TYPE_CHECKING:
    from splatwizard_core.tooling import Entry

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
LONGEST_SUMMARY = 160
SORTS = ("symbols", "positions", "arrays", "gaussians", "vectors")
"""Values of the field `codes`."""

Rule = tuple[Callable[[Any], bool], str]


def _is(*types: type) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, types) and (bool in types or not isinstance(value, bool))


def _names(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and all(isinstance(each, str) and each for each in value) and bool(value)


TARGET = re.compile(r"[\w.]+:[\w.]+")
TEXT: Rule = (_is(str), "a text")
NUMBER: Rule = (_is(int, float), "a number")
COUNT: Rule = (lambda value: _is(int)(value) and value >= 0, "a whole number")
FLAG: Rule = (_is(bool), "True or False")
NAMES: Rule = (_names, "a list of names")
SUFFIX: Rule = (
    lambda value: value == "" or (isinstance(value, str) and value.startswith(".") and len(value) > 1),
    'such as ".ply", or "" (by --format alone)',
)
SUFFIXED: Rule = (
    lambda value: isinstance(value, str) and bool(re.fullmatch(r"[\w-]*(\.[\w-]+)+", value)),
    'such as ".ply", or the name of a file such as "meta.json"',
)
WHERE: Rule = (lambda value: isinstance(value, str) and bool(TARGET.fullmatch(value)), '"module:attribute"')
FIGURES: Rule = (
    lambda value: isinstance(value, str) and bool(DECLARED.fullmatch(value)),
    '"package:file.toml", a file in that package',
)
MODULES: Rule = (
    lambda value: all(WHERE[0](each) for each in (value if isinstance(value, list) else [value])),
    '"module:attribute" of a NativeModule, or a list of them',
)
DIRECTION: Rule = (lambda value: value in ("higher", "lower"), '"higher" or "lower"')
SETTING: Rule = (
    lambda value: isinstance(value, str) and (value == "" or bool(re.fullmatch(r"[\w.]+=\S+", value))),
    'such as "prefixes=8", the setting with which a file has cuts, or "" (always)',
)
OVER: Rule = (lambda value: value in ("image", "views", "model"), '"image", "views" or "model"')
CODES: Rule = (lambda value: value in SORTS, f"one of {', '.join(SORTS)}")
ANY: Rule = (lambda value: True, "")

METRIC: dict[str, Rule] = {
    **{field.name: ANY for field in dataclasses.fields(MetricInfo)},
    "direction": DIRECTION, "digits": COUNT, "position": NUMBER, "label": TEXT, "unit": TEXT, "settings": WHERE,
    "diagnostic": FLAG, "slow": FLAG, "unrounded": FLAG, "pixelwise": FLAG, "over": OVER,
}  # fmt: skip
FIELDS: Mapping[str, Mapping[str, Rule]] = {
    "method": {
        "presets": NAMES, "rates": NAMES, "bd_anchor": COUNT, "default": FLAG, "published": FIGURES, "title": TEXT,
        "prefixes": SETTING, "training_free": FLAG, "available": WHERE,
    },
    "metric": METRIC,
    "coder": {"codes": CODES, "available": WHERE, "stores": TEXT, "prefixes": SETTING},
    "exporter": {"suffix": SUFFIX},
    "importer": {"suffix": SUFFIXED},
    "command": {"position": NUMBER, "completes": FLAG},
    "check": {"group": TEXT, "needs": ANY},
    "dataset": {
        "looks_for": TEXT, "without_poses": TEXT, "title": TEXT, "scenes": NAMES, "table_scenes": NAMES,
        "folders": ANY, "prefix": TEXT, "procedural": FLAG, "default": FLAG,
    },
}  # fmt: skip
"""Kind -> its fields. Of a kind that is not here nothing is known; a rasterizer's declaration checks itself."""
REQUIRED = {"metric": "direction", "coder": "codes", "exporter": "suffix", "importer": "suffix"}


def check_entry(entry: Entry) -> None:
    """Hold one entry to what its kind takes. Raises BrokenContractError."""
    whose = f"{entry.kind} '{entry.name}'"
    if entry.kind != "check":  # those are headings of lines
        hold(NAME.fullmatch(entry.name), f"{whose} has a name that nobody can type", f"rename it: {NAME.pattern}")
    summary = entry.summary
    hold(
        summary.strip() and "\n" not in summary and len(summary) <= LONGEST_SUMMARY,
        f"{whose} has the summary {summary[:40]!r}",
        f"say in one line of at most {LONGEST_SUMMARY} letters what it is",
    )
    hold(
        "TODO" not in summary,
        f"{whose} still has the summary {summary[:60]!r}",
        "registry.add(..., summary=...): say what it is, `sw list-plugins` prints it",
    )
    try:
        json.dumps(dict(entry.declared), allow_nan=False)
    except (TypeError, ValueError) as error:
        hold(False, f"{whose} declares something that is no plain value: {error}", "declare texts, numbers, lists")
    if entry.kind == "rasterizer":
        from splatwizard_core.api import RasterizerInfo

        RasterizerInfo.from_entry(entry)  # its own message names the field
        return
    if entry.kind not in FIELDS:
        return
    known = {**FIELDS[entry.kind], "native": MODULES}  # of any kind: what `sw build-kernels` compiles
    wanted = REQUIRED.get(entry.kind)
    unknown = next((f", but '{n}', which its kind does not have" for n in entry.declared if n not in known), "")
    hold(
        wanted is None or wanted in entry.declared,
        f"{whose} does not declare '{wanted}'{unknown}",
        f"registry.add(..., {wanted}=...): {known[wanted][1] if wanted else ''}",
    )
    for name, value in entry.declared.items():
        hold(name in known, f"{whose} declares '{name}', which its kind does not have", f"known: {', '.join(known)}")
        legal, form = known[name]
        hold(legal(value), f"{whose} declares {name}={value!r}", f"it must be {form}")

"""Facts that installed packages declare in their registry entries: how metrics are written, published data sets.

A record may name a metric, a data set or a method that is not installed here: it is then shown by its name, and
nothing more is known of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from splatwizard_core.tooling import load_plugins, resolve


@dataclass(frozen=True)
class MetricStyle:
    """Spelling of one metric: its name in tables, its unit, its decimals.

    label       as papers write it; the metric's name if nothing is declared
    unit        "dB", or nothing
    digits      decimals in tables
    position    place in tables, smaller first; infinite if nothing is declared
    diagnostic  whether it only tells conventions apart, and stands in no table
    """

    label: str
    unit: str = ""
    digits: int = 4
    position: float = math.inf
    diagnostic: bool = False

    @property
    def heading(self) -> str:
        """Label and unit."""
        return f"{self.label} {self.unit}".strip()


@dataclass(frozen=True)
class DatasetFacts:
    """A published data set.

    title       as papers write it
    scenes      those of published tables; empty: any
    prefix      what folders may have before the name of a scene ("scan" before DTU's "24")
    """

    title: str
    scenes: tuple[str, ...] = ()
    prefix: str = ""

    def scene_of(self, folder: str) -> str:
        """Name of the scene in a folder: the published one that is meant, else the folder's own name."""
        bare = folder.removeprefix(self.prefix) if self.prefix else folder
        return bare if bare in self.scenes else folder


def metric_style(name: str) -> MetricStyle:
    """Spelling of a metric, as its entry declares it.

    Where no metric has the exact name, as in records of others, case does not count, and `-` and `_` are alike.
    A diagnostic metric, which tells conventions apart, is shown by its exact name.
    """
    metrics = load_plugins().metrics
    if name in metrics:
        entry = metrics.entry(name)
    else:
        entry = next((each for each in metrics if metric_key(each.name) == metric_key(name)), None)
    declared: Mapping[str, Any] = entry.declared if entry is not None else {}
    digits, position = declared.get("digits"), declared.get("position")
    by_name = declared.get("diagnostic", False)
    return MetricStyle(
        name if by_name else str(declared.get("label", name)),
        "" if by_name else str(declared.get("unit", "")),
        digits if isinstance(digits, int) and 0 <= digits < 16 else MetricStyle.digits,
        position if isinstance(position, (int, float)) else math.inf,
        bool(by_name),
    )


def metric_key(name: str) -> str:
    """Name of a metric by which its spellings are compared: lower case, `-` as `_`."""
    return name.lower().replace("-", "_")


def dataset_facts(name: str) -> DatasetFacts:
    """Title and published scenes of a data set."""
    datasets = load_plugins().datasets
    declared: Mapping[str, Any] = datasets.entry(name).declared if name in datasets else {}
    scenes = declared.get("table_scenes", declared.get("scenes", ()))
    return DatasetFacts(str(declared.get("title", name)), tuple(map(str, scenes)), str(declared.get("prefix", "")))


def method_title(method: str) -> str:
    """Name of a method as its paper writes it; its key where nothing is declared."""
    methods = load_plugins().methods
    return str(methods.entry(method).declared.get("title", method)) if method in methods else method


def rate_position(method: str, rate: str) -> float:
    """Place of a rate point in the order that its method declares; infinite where it declares none."""
    methods = load_plugins().methods
    declared = methods.entry(method).declared.get("rates", ()) if method in methods else ()
    return list(declared).index(rate) if rate in declared else math.inf


def bd_anchor_rank(method: str) -> float:
    """Rank of a method among those that BD-rates usually compare against, smallest first; infinite for others."""
    methods = load_plugins().methods
    declared: Mapping[str, Any] = methods.entry(method).declared if method in methods else {}
    rank = declared.get("bd_anchor")
    return rank if isinstance(rank, (int, float)) else math.inf


def uncompressed(encoders: Iterable[tuple[str, str]]) -> str:
    """Number format of the parameters in a file that holds them as they are; empty if anything compressed them.

    encoders    (kind, name) of the parts that served the encoding
    """
    coders = load_plugins().coders
    names = [name for kind, name in encoders if kind == "coder"]
    return str(coders.entry(names[0]).declared.get("stores", "")) if len(names) == 1 and names[0] in coders else ""


def float32_bytes(encoders: Iterable[tuple[str, str]], counts: Mapping[str, int], config: object) -> int | None:
    """Bytes that the Gaussians of a compressed file take as float32: what the literature calls the size of 3DGS.

    encoders    (kind, name) of the parts that served the encoding
    config      the method's values, which hold `sh_degree`

    None where the file is no compressed one, holds something else than explicit Gaussians, or it cannot be told.
    """
    coders = load_plugins().coders
    declared = [coders.entry(name).declared for kind, name in encoders if kind == "coder" and name in coders]
    whole = [each for each in declared if each.get("codes") == "gaussians"]
    degree = config.get("sh_degree") if isinstance(config, Mapping) else None
    if len(whole) != 1 or "stores" in whole[0] or set(counts) != {"num_gaussians"} or degree not in range(4):
        return None
    return 4 * (11 + 3 * (degree + 1) ** 2) * counts["num_gaussians"]  # mean, scale, quaternion, opacity; harmonics


def encoding_keys(method: str) -> tuple[str, ...]:
    """Keys of a method that its training does not read: those it says itself, else `codec`."""
    try:
        return tuple(load_plugins().methods.entry(method).load().Config.ENCODING)
    except Exception:  # not installed, another release, or a stranger's fault
        return ("codec",)


def rate_settings(method: str, preset: str | None, rate: str | None) -> tuple[set[str], dict[str, Any]]:
    """Keys that a rate point of an installed method sets, and its whole configuration; empty if that cannot be told."""
    try:
        found = resolve(load_plugins().methods.entry(method).load(), preset, rate)
    except Exception:  # not installed, another release, or a stranger's fault: the record alone has to do
        return set(), {}
    keys = {key for key, who in found.provenance.items() if who.startswith("rate ")}
    return keys, found.config.model_dump(mode="json")

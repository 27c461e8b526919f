"""Which rasterizer serves a request: read off what is asked for, matched with what each one declares."""

from __future__ import annotations

from splatwizard_core.errors import PluginError
from splatwizard_core.plugins.registry import Entry
from splatwizard_core.rendering.rasterizer import Feature, RasterizerInfo


def info_from_entry(entry: Entry) -> RasterizerInfo:
    """What a registry entry declares, checked. Raises PluginError for an unknown feature or field."""
    declared = dict(entry.declared)
    features = frozenset(declared.get("features", ()))
    unknown = features - {f.name for f in Feature}
    if unknown:
        raise PluginError(
            f"rasterizer '{entry.name}' of {entry.distribution} declares unknown feature {sorted(unknown)}"
        )
    min_cc = declared.get("min_cc")
    return RasterizerInfo(
        name=entry.name,
        devices=frozenset(declared.get("devices", ("cpu",))),
        dtypes=frozenset(declared.get("dtypes", ("float32",))),
        features=features,
        available=declared.get("available"),
        combos_forbidden=tuple(frozenset(c) for c in declared.get("combos_forbidden", ())),
        exactness=declared.get("exactness", "exact"),
        speed=int(declared.get("speed", 0)),
        min_cc=None if min_cc is None else (int(min_cc[0]), int(min_cc[1])),
    )

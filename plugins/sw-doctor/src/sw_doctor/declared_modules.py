"""Native modules that the core and the registered entries declare, by name: nothing is imported to list them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatwizard_core.tooling import PluginManager

CORE_MODULES = ("splatwizard_native.face_operations:POOL", "splatwizard_native.fused.native:TRAINING")


def declared_modules(plugins: PluginManager) -> list[str]:
    """Targets "module:attribute", each once: the core's own, then those that registry entries declare as `native`."""
    targets = [*CORE_MODULES]
    for registry in plugins.registries.values():
        for entry in registry:
            declared = entry.declared.get("native") or ()
            targets += [declared] if isinstance(declared, str) else declared
    return list(dict.fromkeys(targets))

"""What may be provided by installed packages, and how it is found."""

from splatwizard_core.plugins.hookspecs import hookimpl, hookspec
from splatwizard_core.plugins.manager import PluginInfo, PluginManager, load_plugins
from splatwizard_core.plugins.registry import Entry, Registry

__all__ = ["Entry", "PluginInfo", "PluginManager", "Registry", "hookimpl", "hookspec", "load_plugins"]

"""The registries of what installed packages provide, and how those packages are found."""

from splatwizard_core.plugins.hookspecs import hookimpl, hookspec
from splatwizard_core.plugins.loading import PluginInfo
from splatwizard_core.plugins.manager import PluginManager, load_plugins
from splatwizard_core.plugins.registry import Coders, Entry, Registry

__all__ = ["Coders", "Entry", "PluginInfo", "PluginManager", "Registry", "hookimpl", "hookspec", "load_plugins"]

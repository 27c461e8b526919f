"""What this package provides."""

from splatwizard_core.plugins import Registry, hookimpl  # noqa: F401

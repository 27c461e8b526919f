"""Checks that any plugin can run against its own parts; importable without pytest."""

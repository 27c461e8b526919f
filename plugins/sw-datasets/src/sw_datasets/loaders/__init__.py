"""Readers of scene folders: one module for each layout on disk."""

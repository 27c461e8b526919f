"""Faster versions of plain functions, same signatures; callers fall back to the plain ones without this folder."""

"""Coders of plain numbers and indices without loss."""

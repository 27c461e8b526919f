"""Anchor models (Scaffold-GS family): model, training stage and file sections shared by anchor methods."""

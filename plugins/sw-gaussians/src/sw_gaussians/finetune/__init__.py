"""Stages of Splatwizard methods that start from a trained scene: prune, fine-tune, distil."""

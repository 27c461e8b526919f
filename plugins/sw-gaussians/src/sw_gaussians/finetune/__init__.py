"""Stages that start from a trained scene: pruning, fine-tuning, distillation."""

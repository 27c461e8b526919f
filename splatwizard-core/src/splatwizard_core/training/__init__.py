"""Training: stages, schedules, optimizer, density-control contract, checkpoints and configuration."""

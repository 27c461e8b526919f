"""Context models: networks and grids that predict the parameters of entropy models."""

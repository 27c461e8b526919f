"""Drawing: the contract of rasterizers, and the choice among those that are installed."""

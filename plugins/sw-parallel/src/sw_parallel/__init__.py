"""One training in several processes: see `sw_parallel.ranks` and `sw_parallel.followers`."""

__version__ = "0.3.0"

"""Tools for authors of Splatwizard packages: a package to start from, and the checks that hold it to the contracts."""

__version__ = "0.3.0"

"""Reports: what many result records say together, as tables, curves and one self-contained page."""

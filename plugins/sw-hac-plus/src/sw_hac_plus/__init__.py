"""HAC++: compression of anchors with a hash grid and an intra-anchor context, as a method of Splatwizard."""

__version__ = "0.3.0"

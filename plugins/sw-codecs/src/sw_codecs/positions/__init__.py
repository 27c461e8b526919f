"""Position codecs for integer points, and the spatial order in which points are stored."""

"""ChimeraGS: parts of several methods in one, and a learned mask on what depends on the view."""

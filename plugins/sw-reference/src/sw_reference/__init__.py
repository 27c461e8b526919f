"""The pure-torch oracle of every Splatwizard rasterizer, and the checks that hold others against it."""

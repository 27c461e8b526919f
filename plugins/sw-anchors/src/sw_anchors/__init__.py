"""Anchors that spawn Gaussians per view: model, training stage and file sections of Splatwizard's anchor methods."""

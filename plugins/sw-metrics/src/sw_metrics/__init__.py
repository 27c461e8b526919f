"""LPIPS in the three forms that published tables use, for Splatwizard."""

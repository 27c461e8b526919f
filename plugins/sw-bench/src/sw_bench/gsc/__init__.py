"""`sw bench --protocol mpeg-gsc`: trained models through codecs, after the MPEG GSC exploration (2025)."""

TITLE = "after the MPEG GSC exploration (2025), own renderer and cameras"
"""Name of the protocol, wherever its figures are printed. It is conformant with nothing."""

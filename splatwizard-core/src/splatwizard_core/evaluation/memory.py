"""Peak memory, as the evaluation protocols need it: see splatwizard_core.memory."""

from splatwizard_core.memory import MemoryMeter, peak_rss_bytes, reset_peak_rss, rss_bytes

__all__ = ["MemoryMeter", "peak_rss_bytes", "reset_peak_rss", "rss_bytes"]

"""A decoder for .swz files that was written from docs/bitstream.md and nothing else, a file for each chapter.

It shares no code with the packages (a test looks), uses Python and numpy, and cares for clarity alone: if it and the
packages disagree, either the page or the packages are wrong. It trusts its input, beyond the checksums.
"""

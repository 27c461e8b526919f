"""Native modules: compiled kernels, found prebuilt, in the cache, or compiled on first use."""

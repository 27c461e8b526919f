"""Archives of the published data sets: where they are, fetched, checked, unpacked."""

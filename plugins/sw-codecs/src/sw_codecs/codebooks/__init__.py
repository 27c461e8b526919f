"""Training of codebooks and the search in them, in bounded memory."""

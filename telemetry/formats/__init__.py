"""One file a format: bytes in, samples or tags out."""

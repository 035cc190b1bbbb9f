"""One module for each file format: bytes in, samples or tags out."""

"""The daemon with vehicles on its links: missions, coverage, gaps, terrain data."""

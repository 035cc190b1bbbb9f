"""The default refiner: tracks, joint adjustment, map registration, ties, terrain (beyond the paper)."""

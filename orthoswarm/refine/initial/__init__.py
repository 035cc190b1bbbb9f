"""Start values of the exterior orientation without a map, from pairs of photos and what was recorded."""

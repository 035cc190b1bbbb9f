"""Value types that every stage shares: frame, camera, ground grid, placed frame, plan, errors; no stage, no raster."""

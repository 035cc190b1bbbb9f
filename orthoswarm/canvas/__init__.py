"""The out-of-core canvas: an RGBA raster of any size in memory-mapped tiles, with overviews and versions."""

"""Rasters and pictures in and out: the basemap, height models, map tiles, picture files, resampling."""

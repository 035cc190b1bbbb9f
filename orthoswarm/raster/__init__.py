"""Rasters and pictures in and out: the basemap, height models, tile folders, picture files, resampling."""

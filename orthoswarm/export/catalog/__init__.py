"""A map in tiles: a COG a tile, a virtual raster of all, and a STAC collection that describes tiles and vehicles."""

"""The orthoimage as web map tiles, drawn once for all files that hold them: MBTiles, PMTiles, KMZ."""

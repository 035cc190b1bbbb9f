"""Files that other programs open: COG, MBTiles, KMZ, GeoPackage, a folder for OpenDroneMap; sheets and places."""

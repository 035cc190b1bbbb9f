"""The area to map and its no-fly zones, read from GeoJSON or KML text."""

"""Places (finds and vehicles) for other programs: Cursor-on-Target, GeoJSON, KML, CSV, GPX."""

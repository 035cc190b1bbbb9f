"""The map as others file or print it: STAC item, GeoPDF sheet, and an offline pack with a page."""

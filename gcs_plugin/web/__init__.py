"""The daemon's HTTP side: API, map tiles, live events, and the web page."""

"""The daemon's web server: HTTP API, map tiles, live events, and the web page."""

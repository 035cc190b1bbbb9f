"""The daemon's HTTP API, its pages and its tiles."""

"""The daemon: one process that connects missions, telemetry, pictures and mosaic; computing is done by libraries."""

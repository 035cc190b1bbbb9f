"""The daemon: one process that ties missions, telemetry, pictures and mosaic together. It ties, it does not compute."""

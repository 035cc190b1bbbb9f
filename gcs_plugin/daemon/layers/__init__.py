"""Map layers of the daemon: canvases and their generations, the real-time layer, web tiles."""

"""The orthoimage: an out-of-core tiled canvas, the real-time module (paper III.B) and the final renderer."""

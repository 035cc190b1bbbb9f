"""From placed frames to the orthoimage: footprints, the real-time module (paper III.B), seam labels, the renderer."""

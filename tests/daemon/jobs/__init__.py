"""Jobs of the daemon: queue, legs in flight, refinement, late pictures."""

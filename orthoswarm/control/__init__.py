"""Ground control: surveyed points that move a refined block onto the ground."""

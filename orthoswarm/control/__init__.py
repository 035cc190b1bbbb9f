"""Ground control points: the similarity that moves a refined block onto surveyed points."""

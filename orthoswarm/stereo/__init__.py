"""The visible surface (ground, roofs, crowns) from pairs of overlapping pictures with solved cameras."""

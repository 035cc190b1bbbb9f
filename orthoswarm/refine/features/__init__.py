"""Correspondences between pictures: tracked corners, matched features, pair homographies, first focal length."""

"""What pictures show of each other: tracked corners, matched features, pair homographies, first focal length."""

"""The ground below the pictures: terrain, dense points, given height models, tall things."""

"""The ground below the pictures: terrain, dense points, user height models, tall surfaces."""

"""How fast the stages are, and how much load the ground station bears."""

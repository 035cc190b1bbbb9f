"""What runs when: first and second pass of each vehicle, batches, refinement in flight."""

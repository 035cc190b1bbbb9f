"""A photo's pose from its own tags: merged, weighed against each other, checked."""

"""Refined blocks are moved: onto surveyed points (ground control), or onto each other (areas of a large swarm)."""

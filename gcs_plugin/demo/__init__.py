"""The demonstration: a swarm, its cameras and a city, all simulated, around the real daemon."""

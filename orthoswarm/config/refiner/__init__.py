"""Thresholds of the refiner, one module a stage."""

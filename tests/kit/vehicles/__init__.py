"""Simulated vehicles and their cameras, for tests."""

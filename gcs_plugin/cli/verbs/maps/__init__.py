"""Verbs that make, inspect, measure and export maps."""

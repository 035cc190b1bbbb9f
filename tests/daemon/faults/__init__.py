"""Crashes, power cuts, overload, start and stop."""

"""Onto the map and onto neighbours: coarse registration, tie points, absolute orientation, late pictures."""

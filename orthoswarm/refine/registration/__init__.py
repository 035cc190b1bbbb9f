"""Registration on the map and to neighbours: coarse registration, tie points, absolute orientation, late pictures."""

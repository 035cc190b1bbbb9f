"""Lines shared among vehicles and cut into sorties; flight times; separation in height and time."""

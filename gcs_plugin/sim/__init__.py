"""Simulated vehicles: small autopilots that speak real MAVLink, for tests, demonstrations and load measurements.

They reproduce the measured behaviour of ArduCopter 4.7 and PX4 (docs/vehicles.md), with its peculiarities. They do not
replace the real autopilots, against which the same tests can be run.
"""

"""Simulated vehicles: small autopilots that speak real MAVLink, for tests, demonstrations and load measurements.

They behave as ArduCopter 4.7 and PX4 were measured to behave (docs/vehicles.md), oddities included; they are no
replacement for the real ones, against which the same tests run where there are any.
"""

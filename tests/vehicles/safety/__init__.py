"""Tests of what keeps vehicles in the air and on the ground safe: starts, commands to stop, distances, alarms."""

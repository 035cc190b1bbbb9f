"""One reading of telemetry and what is done with many: timeline, course over ground, rotations, findings."""

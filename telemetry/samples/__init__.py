"""Single telemetry samples and series of them: timeline, course over ground, rotations, findings."""

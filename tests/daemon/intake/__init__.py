"""Pictures, poses and events into the daemon."""

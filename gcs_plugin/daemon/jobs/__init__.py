"""Jobs of the daemon: a durable queue, worker processes, refinement, and publishing."""

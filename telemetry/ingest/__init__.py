"""From inputs to frames: finds photos, videos and logs, pairs them, and reports what is suspicious."""

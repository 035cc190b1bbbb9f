"""From inputs to frames: finds photos, videos and logs, pairs them, and tells what is suspicious."""

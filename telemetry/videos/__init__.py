"""Pictures of a video with the pose of their own packet."""

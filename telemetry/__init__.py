"""Every way to learn where a camera was: readers that yield orthoswarm Frames."""

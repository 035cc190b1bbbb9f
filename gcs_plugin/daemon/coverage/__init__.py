"""Coverage in flight: which ground of the planned area was seen well, which was missed, and why."""

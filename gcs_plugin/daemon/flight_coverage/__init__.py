"""Coverage in flight: which ground of the planned area was covered well, which was missed, and why."""

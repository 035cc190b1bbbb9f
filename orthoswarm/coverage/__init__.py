"""Which ground of an area the pictures have seen well enough, what they have missed, and why."""

"""Whether vehicles keep apart: before a start, in flight, on their ways home, and in the times of their takeoffs."""

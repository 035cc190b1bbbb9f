"""Whether vehicles keep apart: before a start, in flight, and in the times of their takeoffs."""

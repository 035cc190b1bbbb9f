"""Benchmarks behind `orthoswarm bench`: accuracy, growth of the cost, other programs on the same photos."""

"""Benchmarks of `orthoswarm bench`: accuracy, cost by number of pictures, comparison with other programs."""

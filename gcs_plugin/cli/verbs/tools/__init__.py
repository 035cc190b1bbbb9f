"""Verbs for data sets with truth, benchmarks, weights and the machine."""

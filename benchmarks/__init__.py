"""Scripts that measure: each answers one question, and docs/benchmarks.md holds the answers."""

"""Random faulty flights: what the coverage says against what the true cameras saw (small version of the benchmark)."""

import pytest

from benchmarks.robustness.coverage_faults import simulate


@pytest.mark.parametrize("seed", [2, 3, 7])
def test_coverage_agrees_with_truth_and_gap_flights_close_the_gaps(seed: int) -> None:
    outcome = simulate(seed, side_m=260.0)
    assert outcome.seen < 0.99  # the faults left something to be found
    assert outcome.falsely_seen <= 0.001
    assert outcome.falsely_missed <= 0.01
    assert outcome.after >= 0.999

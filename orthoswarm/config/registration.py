"""Registration onto the map and onto neighbours."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """Registration onto the map and onto neighbours."""

    first_tie_reach_m: float = 14.0
    """How far a tie point is searched on the map after the coarse registration, to each side; chosen, not measured."""
    evidence_tolerances_m: tuple[float, float, float] = (0.7, 1.5, 3.0)
    """Distances within which tie points agree on a place on the map: after a good adjustment, with tilt and drift left,
    for sparse photos; chosen, not measured."""
    evidence_small_half_m: float = 4.0
    """Half a patch where those of the usual size confirm nothing: so that flights of three photos have some dozens;
    chosen, not measured."""
    false_matches: float = 1e-4
    """A flight is taken to lie on the map if a map of other ground would show an agreement of tie points as good as the
    one found so many times only (expected number of false matches); measured by benchmarks/wrong_maps.py."""
    leg_by_chance: float = 0.01
    """A leg of such a flight is matched if its ties agree with its place by chance with this probability only."""

    # The map against the receivers
    receiver_bias_sigma_m: float = 1.5
    """Bias of a receiver without corrections over a flight, an axis: multipath, satellites of its own (chosen; good
    receivers under open sky differ by 1 to 2 m)."""
    receiver_common_sigma_m: float = 1.5
    """The part of the error that all receivers at a place and time share, an axis: ionosphere and orbits. The GPS
    standard (SPS PS 2020) commits to 8 m (95 %) horizontally on average; 3 to 4 m are usual, most of it shared
    (chosen)."""
    corrected_sigma_m: float = 0.5
    """A position that states at most this sigma was corrected (RTK, PPK)."""
    corrected_floor_m: float = 0.05
    """Corrected positions are not trusted better than this: antenna offset, base station (chosen)."""
    offset_probability: float = 0.01
    """The map is doubted if the receivers would be so far from a right map with this probability only."""

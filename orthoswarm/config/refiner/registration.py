"""Registration: coarse shift onto the map, tie points, links, absolute orientation, neighbours, the map's offset.

Scales named robust are those of the Geman-McClure kernel, squared, of normalised residuals.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig:
    """Registration onto the map and onto neighbours."""

    # Coarse registration: mosaics of some consecutive pictures (strips) correlated with the map
    coarse_reach_m: tuple[float, float] = (60.0, 150.0)
    """How far strips are searched, metres: first, and where that is refuted (chosen: receivers without corrections are
    within the first)."""

    # Tie points on the map
    first_tie_cell_m: float = 50.0
    """One tie point a leg in each cell of this size, metres, after the coarse registration (chosen for cost)."""
    tie_cell_m: float = 30.0
    """The same once the flight lies on the map (chosen for cost)."""

    # Evidence
    false_matches: float = 1e-4
    """A flight is taken to lie on the map if a map of other ground would show an agreement of tie points as good as the
    one found so many times only (expected number of false matches); measured by benchmarks/robustness/wrong_maps.py."""

    # Links: points of one leg observed in pictures of other legs, or of neighbouring vehicles
    link_cell_m: float = 40.0
    """One point a leg in each cell of this size, metres (chosen for cost)."""
    link_pictures: int = 3
    """Most other legs in which a point is observed, one picture each (chosen for cost)."""

    # Heights of ground that only oblique views show, from the map
    oblique_cell_share: float = 0.06
    """Distance of the positions, as a share of the flying height (chosen for cost) ..."""

    # The map against the receivers
    receiver_bias_sigma_m: float = 1.5
    """Bias of a receiver without corrections over a flight, an axis: multipath, satellites of its own (chosen; good
    receivers under open sky differ by 1 to 2 m)."""

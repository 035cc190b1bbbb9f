"""Radiometric balancing of the pictures. Sigmas are of natural logarithms of colour factors (0.05 is 5 %)."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class RadiometryConfig:
    """Radiometric balancing of the pictures."""

    # Solution
    reweightings: int = 3
    """Rounds of reweighting; then factors lie within 0.2 % of where 40 rounds lead (154 pictures of three vehicles of
    different tone and 1,017 of ten)."""
    solver_steps: int = 100
    """Most steps of conjugate gradients a round (4 to 15 were needed)."""
    solver_tolerance: float = 0.1
    """Preconditioned residual, as a share of the first one, at which a round ends; the next one goes on from there
    (0.01 takes 1.7 times the time and changes factors by 0.03 % at most)."""

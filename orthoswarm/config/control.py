"""Ground control: surveyed points that move the map onto the ground."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlConfig:
    """Ground control."""

    survey_sigma_m: float = 0.05
    """Sigma of a surveyed position, an axis, where its file states none, metres: a network receiver's (chosen). Where
    there are enough points to see how far they really scatter, that counts instead if it is more."""
    pointing_sigma_px: float = 1.0
    """Sigma of a point's place in a photo, in pixels; photos of a point count as independent (chosen)."""

"""Ground control: surveyed points that move the map onto the ground."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ControlConfig:
    """Ground control."""

    survey_sigma_m: float = 0.05
    """Sigma of a surveyed position, an axis, where its file states none, metres: a network receiver's (chosen)."""
    pointing_sigma_px: float = 1.0
    """Sigma of a point's place in a photo, in pixels; photos of a point count as independent (chosen)."""
    height_sigma_m: float = 10.0
    """Sigma of a point's height over the mapped ground below it, metres: holds a point that one photo shows, or photos
    from nearly the same place; rays from several sides are not held by it (chosen)."""
    shift_sigma_m: float = 100.0
    """What is known of the shift before the control points: nothing, so that they decide it (chosen)."""
    map_border_m: float = 0.5
    """A basemap is turned and scaled by so little that its place at the root-mean-square radius of the photos changes
    by this, one sigma, metres: one or two points shift it, more points turn and scale it, too (chosen)."""
    receivers_border_m: float = 1.5
    """The same for photos that lie where receivers say: their drift turns and scales a block (as
    `records.position_sigma_m`)."""
    receivers_local_sigma_m: float = 0.3
    """How far a block without a map is bent besides shift, turn and scale, one sigma, metres. Measured: residuals at
    five control points of a suburb (172 photos) are 0.3 m an axis."""
    mistake_probability: float = 1e-3
    """A control point is left out if the others would put it so far from its survey with this probability only."""
    farthest_m: float = 1000.0
    """Control points farther from every photo than this belong elsewhere: a wrong coordinate system (chosen)."""

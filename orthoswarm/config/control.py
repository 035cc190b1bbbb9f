"""Ground control: surveyed points that move the map onto the ground."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlConfig:
    """Ground control."""

    survey_sigma_m: float = 0.05
    """Sigma of a surveyed position, an axis, where its file states none, metres: a network receiver's (chosen). Where
    there are enough points to see how far they really scatter, that counts instead if it is more."""
    scatter_told_m: float = 0.5
    """Points that scatter by more than this are warned about, one sigma of an axis, metres (chosen: more than receivers
    with corrections are off)."""
    scatter_fewest: int = 5
    """Fewest points without a stated sigma whose scatter is estimated (chosen): with fewer one mistake decides it."""
    pointing_sigma_px: float = 1.0
    """Sigma of a point's place in a photo, in pixels; photos of a point count as independent (chosen)."""
    height_sigma_m: float = 2.0
    """Sigma of a point's height over the solved terrain below it, metres: holds a point that one photo shows, or photos
    from nearly the same place; rays from several sides are hardly held by it (chosen)."""
    shift_sigma_m: float = 100.0
    """What is known of the shift before the control points: nothing, so that they decide it (chosen)."""
    border_m: float = 0.5
    """Photos on a basemap, or where receivers say, are turned and scaled by so little that a place at their
    root-mean-square radius changes by this, one sigma, metres: one or two points shift them, more points turn and scale
    them, too. Measured on 172 photos where receivers say (radius 54 m) by five control points, each choice of two of
    them placing the other three: with 0.05, 0.5 and 1.5 m these are 0.72, 0.75 and 0.99 m off (three points: 0.68, 0.67
    and 0.73 m)."""
    receivers_local_sigma_m: float = 0.4
    """How far a block without a map is bent besides shift, turn and scale, one sigma an axis, metres. Measured on the
    same photos: 0.31 m are left at five points after four unknowns; 73 to 80 % of the points that took no part lie
    within one stated sigma and 90 to 100 % within two."""
    mistake_probability: float = 1e-3
    """A control point is left out if the others would put it so far from its survey with this probability only."""
    farthest_m: float = 1000.0
    """Control points farther from every photo than this belong elsewhere: a wrong coordinate system (chosen)."""

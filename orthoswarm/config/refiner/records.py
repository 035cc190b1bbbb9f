"""Defaults where a picture recorded nothing, and sigmas of what it recorded."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordsConfig:
    """Records: defaults and trust."""

    theta_hat_deg: float = 70.0
    """Horizontal field of view where nothing is known: below that of most drones' cameras (paper III.B)."""
    default_height_m: float = 80.0
    """Height above ground where no photo records one, metres, until pictures give the scale. Measured on two flights at
    90 m with positions only, with 60, 80 and 100 m: error of the map 0.147, 0.142, 0.145 m (95 %: 0.51, 0.51, 0.48),
    heights off by 3.3, 2.8, 2.8 m."""
    usual_heights_m: tuple[float, float] = (50.0, 150.0)
    """Heights between which mapping flights are flown, metres: where the photos' spacing gives a height (chosen)."""
    usual_overlap: float = 0.75
    """Forward overlap of mapping flights as flight planners propose it, share: it makes spacing a height (chosen)."""
    position_sigma_m: float = 1.5
    """Sigma of a horizontal position, an axis, whose source states none, metres; receivers' drift has its own prior.
    Measured: 0.57 m on a real flight with a map (18 photos), whose real-time ground points lie within one stated sigma
    in 97 % of the axes (2 of 2 sigmas: all); 0.5, 1.5 and 3 m give 43 real photos without tags the same place on their
    control points (0.593, 0.593, 0.594 m rms). Drifting receivers exceed it (9 m, simulated)."""
    tagged_tilt_sigma: float = 0.03
    """Error of the ground point at a photo's centre through its recorded attitude, as a share of the height: 1.7
    degrees (chosen; not measured)."""

    # Legs: straight runs of a flight
    leg_reach: int = 3
    """Frames before and after a frame between which the bend of the path is measured (chosen: one is noise)."""

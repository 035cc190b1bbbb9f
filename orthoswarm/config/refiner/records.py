"""Defaults where a picture recorded nothing, and sigmas of what it recorded."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordsConfig:
    """Records: defaults and trust."""

    theta_hat_deg: float = 70.0
    """Horizontal field of view where nothing is known: below that of most drones' cameras (paper III.B)."""
    far_m: float = 20_000.0
    """A position this far from the median of its set cannot be true: no small drone flies farther."""
    far_spreads: float = 10.0
    """... and so many times the median distance: a set may be larger than that (chosen; not measured)."""
    largest_area_m: float = 100_000.0
    """No position of a set lies farther than this from the place where most of them are, metres, however they spread: a
    lost hemisphere (E or W, N or S) puts half of a flight on another continent (chosen: five times `far_m`)."""
    default_height_m: float = 80.0
    """Height above ground where no photo records one, metres, until pictures give the scale. Measured on two flights at
    90 m with positions only, with 60, 80 and 100 m: error of the map 0.147, 0.142, 0.145 m (95 %: 0.51, 0.51, 0.48),
    heights off by 3.3, 2.8, 2.8 m."""
    usual_heights_m: tuple[float, float] = (50.0, 150.0)
    """Heights between which mapping flights are flown, metres: where the photos' spacing gives a height (chosen)."""
    usual_overlap: float = 0.75
    """Forward overlap of mapping flights as flight planners propose it, share: it makes spacing a height (chosen)."""
    moved_m: float = 1.0
    """Steps that are shorter have no direction and no spacing, metres: receivers scatter by about that (chosen)."""
    corner_deg: float = 50.0
    """A change of course above this is a corner between two legs and no bend, degrees (chosen; not measured)."""
    position_sigma_m: float = 1.5
    """Sigma of a horizontal position, an axis, whose source states none, metres; receivers' drift has its own prior.
    Measured: 0.57 m on a real flight with a map (18 photos), whose real-time ground points lie within one stated sigma
    in 97 % of the axes (2 of 2 sigmas: all); 0.5, 1.5 and 3 m give 43 real photos without tags the same place on their
    control points (0.593, 0.593, 0.594 m rms). Drifting receivers exceed it (9 m, simulated)."""
    lag_sigma_s: float = 0.5
    """Sigma of the delay of recorded positions behind the shutter, seconds (chosen; lags of up to 0.4 s are found)."""
    tagged_tilt_sigma: float = 0.03
    """Error of the ground point at a photo's centre through its recorded attitude, as a share of the height: 1.7
    degrees (chosen; not measured)."""
    untagged_tilt_sigma: float = 0.1
    """Error of the ground point at the centre of a photo without a recorded attitude, as a share of the height: 6
    degrees of sway about straight down (chosen; not measured)."""
    pause_s: float = 60.0
    """Photos farther apart in time do not follow each other: the vehicle did something else between (chosen)."""

    # Legs: straight runs of a flight
    leg_reach: int = 3
    """Frames before and after a frame between which the bend of the path is measured (chosen: one is noise)."""
    leg_turn_deg: float = 35.0
    """Least bend of the path at the corner between two legs, degrees (chosen; not measured)."""
    leg_fewest: int = 3
    """Fewer frames are not a leg (chosen)."""
    leg_jump_steps: float = 6.0
    """A step of more than so many median steps and the next field ends a leg (chosen) ..."""
    leg_jump_m: float = 30.0
    """... metres (chosen: receivers' outliers are below)."""
    one_way_deg: float = 35.0
    """Legs within this angle of the longest lead in its direction, degrees; not the opposite one (chosen)."""
    other_way_share: float = 0.3
    """Ways in other directions, as a share of the longest leg, from which on drift and tilt can be told apart (chosen;
    not measured)."""

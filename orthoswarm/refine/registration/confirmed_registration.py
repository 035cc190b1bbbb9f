"""Hypotheses of the coarse registration are verified by tie points; the first that is confirmed counts."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.config import active
from orthoswarm.model.arrays import Array
from orthoswarm.model.placement import MapWindow
from orthoswarm.refine.flight.relative_block import Flight
from orthoswarm.refine.registration.absolute_orientation import (
    FIRST_TIE_REACH_M,
    first_ties,
    load_map,
    map_gsd,
    small_ties,
    tie_half_m,
)
from orthoswarm.refine.registration.coarse_registration import CoarseFit, shift_cameras
from orthoswarm.refine.registration.map_evidence import false_matches_log10
from orthoswarm.refine.registration.map_windows import LoadedMap
from orthoswarm.refine.registration.tie_points import MapMatches
from orthoswarm.refine.surface.vehicle_ground import GroundModel

_EVIDENCE_SMALL_HALF_M: Final = 4.0  # half a patch where those of the usual size confirm nothing


@dataclass(frozen=True, slots=True)
class ConfirmedFit:
    """A coarse registration that tie points confirm.

    Attributes:
        fit: the registration. ground: the map below the flight. matches: the tie points that confirm it.
        false_matches: expected number of agreements as good as theirs on a map of other ground.
    """

    fit: CoarseFit
    ground: LoadedMap
    matches: MapMatches
    false_matches: float


def confirmed(
    flight: Flight, fits: Iterable[CoarseFit], basemap: MapWindow, origin: Array, surface: GroundModel
) -> ConfirmedFit | None:
    """The first registration that tie points confirm; the flight's cameras then are where it puts them.

    Where none is confirmed the cameras stay where they were.

    Args:
        flight: after the adjustment without a map. fits: guesses, the likely first.
        basemap: the map. origin: float64 (2,) of the local frame. surface: ground below the flight.
    """
    before = flight.adjustment.copy()
    config = active().registration
    limit, tests = np.log10(config.false_matches), 0
    for fit in fits:
        shift_cameras(flight, fit.correction)
        ground = load_map(flight, basemap, origin, map_gsd(flight, basemap))
        matches = first_ties(flight, surface, ground)
        tests += 1  # each test is one more chance to agree
        chance = _false_matches_log10(flight, matches, tie_half_m(flight)) + np.log10(tests)
        if chance > limit:  # a few photos have room for a few patches of this size only: more and smaller ones
            half_m, tests = _EVIDENCE_SMALL_HALF_M, tests + 1
            chance = _false_matches_log10(flight, small_ties(flight, surface, ground, half_m), half_m) + np.log10(tests)
        if chance <= limit:
            return ConfirmedFit(fit, ground, matches, float(10.0**chance))
        flight.adjustment = before.copy()
    return None


def _false_matches_log10(flight: Flight, matches: MapMatches, half_m: float) -> float:
    return false_matches_log10(
        flight.adjustment.points[matches.point, :2],
        matches.shift,
        matches.camera.astype(float),
        leg=flight.leg[matches.camera],
        reach_m=FIRST_TIE_REACH_M,
        patch_m=2.0 * half_m,
    )

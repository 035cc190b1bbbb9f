"""Absolute orientation of one vehicle: tie points on the map, links between legs, and the adjustment with both.

Guesses of the coarse registration are verified by tie points; the first that is confirmed counts.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.compute.robust_kernel import robust_weights
from orthoswarm.model.arrays import Array, Flags, Indices, Ints
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.placement import MapWindow
from orthoswarm.model.robust import mad_sigma
from orthoswarm.refine.bundle.adjustment import TRACK_ROBUST_C, Adjustment, MapTies
from orthoswarm.refine.flight.relative_block import BestViews, FlightBlock
from orthoswarm.refine.registration.coarse_registration import CoarseFit, shift_cameras
from orthoswarm.refine.registration.map_evidence import FALSE_MATCHES, false_matches_log10
from orthoswarm.refine.registration.tie_points import LINK_CELL_M, LoadedMap, MapMatches, link_legs, match_points
from orthoswarm.refine.surface.ground_densification import refit_ground
from orthoswarm.refine.surface.vehicle_ground import GroundModel

_PICTURE_GSD_SHARE: Final = 1.07  # ground pixel in which pictures are compared with each other, in pixels at nadir
_MAP_GSD_M: Final = (0.25, 2.0)  # limits of the ground pixel for the map where pictures are finer than the next field
_MAP_GSD_FINE_M: Final = 0.4  # pictures of finer pixels are compared at the coarser of their and the map's
_MAP_GSD_COARSE_M: Final = 0.5  # least ground pixel for all other pictures
_MAP_MARGIN_SHARE: Final = 1.1  # the map is read so many half diagonals beyond the cameras (pictures tilt) ...
_MAP_MARGIN_M: Final = 40.0  # ... and this: the search and a patch
TIE_VIEWS: Final = 3  # fewest pictures that show a point which is compared with the map ...
_TIE_VIEWS_SPARSE: Final = 2  # ... and of photos that are matched in pairs
_TIE_VIEW_WEIGHT: Final = 0.4  # least mean robust weight of its observations
TIE_HEIGHT_M: Final = 3.0  # points farther above or below the ground are not compared: what is around them leans
_TIE_HALF_SHARE: Final = 0.1
"""Half a patch, as a share of the flying height. Measured with half patches of 10, 13, 16 and 20 m from 150 m: on maps
of another date (benchmarks/accuracy/other_dates.py) errors fall up to 16 m, on relief of 25 m they stay ..."""
_TIE_HALF_LIMITS_M: Final = (10.0, 20.0)
"""... within these limits (what is on the ground does not grow with the flying height)."""
TIE_HALF_PX: Final = 8  # ... and at least so many pixels
TIE_REACH_PX: Final = 4  # least search, pixels, where a search in metres is less
FIRST_TIE_REACH_M: Final = 14.0  # search for a tie point after the coarse registration, to each side
TIE_REACH_M: Final = 5.0  # the same once the flight lies on the map
_FIRST_TIE_CELL_M: Final = 50.0  # one tie point a leg in each cell of this size, after the coarse registration (cost)
_TIE_CELL_M: Final = 30.0  # the same once the flight lies on the map (cost)
_FIRST_TIE_CELL_SPARSE_M: Final = 25.0  # first ties of photos matched in pairs: one in each cell of this size
_TIE_CELL_SPARSE_M: Final = 15.0  # later ties of photos matched in pairs: one in each cell of this size
_TIE_PEAK: Final = 0.2  # least correlation of a tie point
_TIE_RATIO: Final = 0.75  # largest ratio of the second peak to the first
TIE_SIGMA_M: Final = 0.35  # sigma of a tie point, an axis, before their residuals tell it
_TIE_SIGMA_LIMITS_M: Final = (0.1, 1.0)  # limits of the sigma by their residuals
_TIE_FEWEST_FOR_SIGMA: Final = 20  # fewer residuals tell no sigma
_EDGE_FEWEST: Final = 60  # fewer tie points do not tell how far strong edges are displaced from texture
_EDGE_MOST: Final = 300  # more are not compared (cost)
_EDGE_SEARCH_M: Final = 2.5  # how far the edges of tie points are searched: the flight is decimetres off by then (cost)
_EDGE_REACH_M: Final = 1.0  # differences farther than this from their median are gross errors
_MODE_M: Final = 0.7  # the shift that most tie points agree on has most others within this distance
_MODE_SCALES_M: Final = (0.5, 0.5, 0.35, 0.25, 0.25)  # scales of the reweighted means that refine it
_LINE_SCALES_M: Final = (4.0, 2.0, 1.0, 0.7, 0.5, 0.5)  # the same for the line of shifts along a leg
_LINE_FEWEST: Final = 6  # fewest tie points of a leg that must agree on such a line ...
_LINE_LEAST_SHARE: Final = 0.6  # ... and the least share of its tie points
_LINE_AGREES_M: Final = 0.7  # tie points this near to the line agree with it
_LINE_APART_M: Final = 0.7  # a leg whose line is nowhere farther from the common shift is moved by the common shift
_FIRST_TIE_SCALES: Final = (36.0, 9.0, 6.0, 6.0)  # robust scales of the first tie points in its steps
TIE_SCALES: Final = (9.0, 6.0)  # the same of the next ones, in the first step and in all others
_SECOND_STEPS: Final = 3  # steps with the second tie points
_RENEWED_STEPS: Final = 4  # steps with renewed tie points, of a flight on the map after two with the old ones
_ROOF_VIEWS: Final = 6  # fewest pictures that show a raised point
_ROOF_VIEW_WEIGHT: Final = 0.5  # least mean robust weight of its observations
_ROOF_HEIGHTS_M: Final = (4.0, 40.0)  # heights over the ground: a floor, and what is probably a wrong track
_ROOF_CELL_M: Final = 30.0  # one roof a leg in each cell of this size (cost)
_ROOF_HALF_M: Final = 7.5  # half a patch: about a roof
_ROOF_REACH_M: Final = 11.0  # how far it is searched: maps lean by up to 0.3 m a metre
_ROOF_RATIO: Final = 0.85  # largest ratio of the second peak to the first; the vote sorts out wrong ones
_LINK_VIEWS: Final = 3  # fewest pictures that show a point which is sought in other legs or by other vehicles
_LINK_VIEW_WEIGHT: Final = 0.5  # least mean robust weight of its observations
_LINK_SIGMA_PX: Final = 0.7  # sigma of a link to another leg, working pixels
_EVIDENCE_SMALL_HALF_M: Final = 4.0  # half a patch where those of the usual size confirm nothing


@dataclass(slots=True)
class AbsoluteOrientation:
    """The ground, the last tie points and their matches; the cameras are in the flight's adjustment.

    roofs: matches of raised points and their heights, for the lean of the map, which all vehicles vote on.
    """

    surface: GroundModel
    ties: MapTies
    matches: MapMatches
    roofs: tuple[MapMatches, Array]


def load_map(flight: FlightBlock, basemap: MapWindow, origin: Array, gsd_m: float) -> LoadedMap:
    """The map under a vehicle's pictures, with a margin for the search."""
    diagonal = float(np.hypot(*flight.pictures.size)) / 2 / flight.focal_px
    reach = _MAP_MARGIN_SHARE * flight.height_m * diagonal + _MAP_MARGIN_M
    return LoadedMap.load(basemap, origin, BoundingBox.around_points(flight.cameras().position[:, :2], reach), gsd_m)


def tie_matches(
    flight: FlightBlock, surface: GroundModel, ground: LoadedMap, *, cell_m: float, reach_m: float,
    half_m: float | None = None, pictures: Flags | None = None,
) -> MapMatches:  # fmt: skip
    """Sure matches of ground points, one for each cell and leg, with the map.

    Ground is compared by its texture: strong edges belong to what leans and casts shadows.

    cell_m: side of a cell. reach_m: search to each side. half_m: half a patch, None: as `tie_half_m`. All metres.
    pictures: bool (N,), the ones to compare, None for all.
    """
    adj = flight.adjustment
    seen = flight.best_views(pictures)
    level = surface.height(adj.points[:, :2])
    height = np.abs(adj.points[:, 2] - level)
    fewest = _TIE_VIEWS_SPARSE if flight.sparse else TIE_VIEWS
    usable = (seen.count >= fewest) & (seen.mean_weight > _TIE_VIEW_WEIGHT) & (height < TIE_HEIGHT_M)
    found = match_points(
        adj.cameras, adj.points, flight.one_per_cell(seen, usable, height, cell_m), camera=seen.camera,
        gray=flight.pictures.gray, ground=ground, level=level, texture=True,
        half=max(TIE_HALF_PX, round((half_m or tie_half_m(flight)) / ground.gsd_m)),
        reach=max(TIE_REACH_PX, round(reach_m / ground.gsd_m)),
    )  # fmt: skip
    return clear_matches(found)


def edge_displacement(flight: FlightBlock, surface: GroundModel, ground: LoadedMap, matches: MapMatches) -> Array:
    """Mean displacement (2,), metres, of strong edges against texture at the same tie points; zero if it is not known.

    Shadows of another hour and what leans in the map displace strong edges most, but texture, too, by 1.0 to 1.1 times
    this difference (regression over simulated cities with exact truth). Subtracting it extrapolates to ground without
    edges.
    """
    adj = flight.adjustment
    step = max(1, -(-len(matches.point) // _EDGE_MOST))
    some = matches.take(np.arange(0, len(matches.point), step))
    camera = np.full(len(adj.points), -1, np.int32)
    camera[some.point] = some.camera
    found = match_points(
        adj.cameras, adj.points, some.point, camera=camera, gray=flight.pictures.gray, ground=ground,
        half=max(TIE_HALF_PX, round(tie_half_m(flight) / ground.gsd_m)),
        reach=max(TIE_REACH_PX, round(_EDGE_SEARCH_M / ground.gsd_m)), level=surface.height(adj.points[:, :2]),
    )  # fmt: skip
    edges = clear_matches(found)
    _, mine, its = np.intersect1d(some.point, edges.point, return_indices=True)
    away = edges.shift[its] - some.shift[mine]
    if len(away) < _EDGE_FEWEST:
        return np.zeros(2)
    away = away[np.hypot(*(away - np.median(away, axis=0)).T) < _EDGE_REACH_M]
    return np.asarray(away.mean(0)) if len(away) >= _EDGE_FEWEST else np.zeros(2)


def clear_matches(matches: MapMatches, ratio: float = _TIE_RATIO) -> MapMatches:
    """Matches with a clear peak; ratio: largest ratio of the second peak to the first."""
    return matches.take((matches.peak > _TIE_PEAK) & (matches.ratio < ratio))


def mode_shift(shift: Array) -> Array:
    """Mode (2,) of the shifts (Q, 2) of tie points: the one with most others near it, then reweighted."""
    if len(shift) == 0:
        return np.zeros(2)
    d2 = ((shift[:, None, :] - shift[None, :, :]) ** 2).sum(-1)
    centre = shift[int((d2 < _MODE_M**2).sum(1).argmax())]
    for scale in _MODE_SCALES_M:
        w = robust_weights(((shift - centre) ** 2).sum(1), scale**2)
        centre = (shift * w[:, None]).sum(0) / w.sum()
    return np.asarray(centre)


def shifted_along(flight: FlightBlock, matches: MapMatches) -> MapMatches:
    """Shift the cameras to where their first matches lie; returns the matches with what is left of their shifts.

    All cameras move by the mode of the shifts, but a leg whose own matches agree on another line of shifts follows it:
    where the tracks broke at a corner, the coarse corrections of two legs are interpolated into each other, and the
    adjustment would reject the right matches at the beginning of a leg as outliers.
    """
    points = flight.adjustment.points[matches.point].copy()
    correction = leg_corrections(flight.leg, matches, mode_shift(matches.shift))
    shift_cameras(flight, correction)
    moved = flight.adjustment.points[matches.point, :2] - points[:, :2]
    return replace(matches, shift=matches.shift - moved)


def leg_corrections(leg: Ints, matches: MapMatches, common: Array) -> Array:
    """Shift of each picture, float64 (N, 2): the common one, except in legs whose matches agree on another line."""
    out = np.tile(common, (len(leg), 1))
    for k in np.unique(leg[leg >= 0]):
        members = np.flatnonzero(leg == k)
        mine = leg[matches.camera] == k
        if int(mine.sum()) < _LINE_FEWEST:
            continue
        t = matches.camera[mine] - members.mean()
        line, agree = _line(t, matches.shift[mine])
        if int(agree.sum()) < max(_LINE_FEWEST, _LINE_LEAST_SHARE * len(t)):
            continue
        ends = np.clip(members - members.mean(), t[agree].min(), t[agree].max())
        own = line[0] + line[1] * ends[:, None]
        if np.hypot(*(own - common).T).max() > _LINE_APART_M:
            out[members] = own
    between, within = np.flatnonzero(leg < 0), np.flatnonzero(leg >= 0)
    if len(between) and len(within):
        out[between] = np.column_stack([np.interp(between, within, out[within, a]) for a in range(2)])
    return out


def _line(t: Array, shift: Array) -> tuple[Array, Flags]:
    """Robust line (2, 2), value and slope, through shifts (Q, 2) along t (Q,), and which shifts lie on it."""
    a = np.column_stack([np.ones(len(t)), t])
    line = np.array([mode_shift(shift), np.zeros(2)])
    for scale in _LINE_SCALES_M:
        w = robust_weights(((shift - a @ line) ** 2).sum(1), scale**2)
        line = np.linalg.solve((a * w[:, None]).T @ a + 1e-9 * np.eye(2), (a * w[:, None]).T @ shift)
    return line, np.asarray(np.hypot(*(shift - a @ line).T) < _LINE_AGREES_M)


def as_ties(matches: MapMatches, points: Array) -> MapTies:
    """Tie points with their places on the map and a first sigma; what was compared is ground, which does not lean."""
    sigma = np.full(len(matches.point), TIE_SIGMA_M)
    return MapTies(matches.point, points[matches.point, :2] + matches.shift, sigma)


def roof_matches(flight: FlightBlock, surface: GroundModel, ground: LoadedMap) -> tuple[MapMatches, Array]:
    """Matches of raised points (roofs) with the map, and their heights over the ground (Q,), metres."""
    adj = flight.adjustment
    seen = flight.best_views()
    height = adj.points[:, 2] - surface.height(adj.points[:, :2])
    usable = (seen.count >= _ROOF_VIEWS) & (seen.mean_weight > _ROOF_VIEW_WEIGHT)
    usable &= (height > _ROOF_HEIGHTS_M[0]) & (height < _ROOF_HEIGHTS_M[1])
    found = match_points(
        adj.cameras, adj.points, flight.one_per_cell(seen, usable, -seen.count, _ROOF_CELL_M), camera=seen.camera,
        gray=flight.pictures.gray, ground=ground, half=max(TIE_HALF_PX, round(_ROOF_HALF_M / ground.gsd_m)),
        reach=max(TIE_HALF_PX, round(_ROOF_REACH_M / ground.gsd_m)),
    )  # fmt: skip
    found = clear_matches(found, _ROOF_RATIO)
    return found, height[found.point]


def add_links(flight: FlightBlock, gsd_m: float) -> int:
    """Observe points of each leg in pictures of other legs and add these observations; returns how many."""
    adj = flight.adjustment
    candidates = np.flatnonzero(flight.leg >= 0)
    if len(np.unique(flight.leg[candidates])) < 2:
        return 0
    seen, chosen = linkable_points(flight, LINK_CELL_M)
    camera, point, uv = link_legs(
        adj.cameras, adj.points, chosen, camera=seen.camera, leg=flight.leg, candidates=candidates,
        gray=flight.pictures.gray, gsd_m=gsd_m,
    )  # fmt: skip
    if len(camera):  # its unknowns keep their values
        tracks = adj.tracks.with_more(camera, point, uv, _LINK_SIGMA_PX)
        flight.adjustment = Adjustment.begin(adj.cameras, tracks, adj.priors, adj.points, adj.free)
        flight.adjustment.common[:] = adj.common
    return len(camera)


def linkable_points(flight: FlightBlock, cell_m: float, pictures: Flags | None = None) -> tuple[BestViews, Indices]:
    """Best views of a flight's points in its pictures, or in some (N,), and one sure point a leg in each cell."""
    seen = flight.best_views(pictures)
    usable = (seen.count >= _LINK_VIEWS) & (seen.mean_weight > _LINK_VIEW_WEIGHT)
    return seen, flight.one_per_cell(seen, usable, -seen.count, cell_m)


def orient_on_map(
    flight: FlightBlock, ground: LoadedMap, matches: MapMatches, surface: GroundModel
) -> AbsoluteOrientation:
    """Adjust a flight with the tie points that confirm its coarse registration, then with new ones."""
    matches = shifted_along(flight, matches)
    ties = as_ties(matches, flight.adjustment.points)
    for k, c in enumerate(_FIRST_TIE_SCALES):
        _step(flight, surface, ties, c)
        if k in (1, 3):
            surface = refit_ground(flight, surface, as_smooth=k == 3)
    roofs = roof_matches(flight, surface, ground)
    if not flight.sparse:
        add_links(flight, working_gsd(flight))
    _step(flight, surface, ties, TIE_SCALES[1])
    surface = refit_ground(flight, surface, as_smooth=True)
    surface, ties, matches = _second_round(flight, ground, surface, _SECOND_STEPS)
    return AbsoluteOrientation(surface, ties, matches, roofs)


def reorient_on_map(
    flight: FlightBlock, ground: LoadedMap, surface: GroundModel, ties: MapTies, pictures: Flags | None = None
) -> tuple[GroundModel, MapTies, MapMatches]:
    """Adjust a flight on the map with new tie points, as after its level was shifted; pictures: (N,), those to use."""
    for _ in range(2):
        _step(flight, surface, ties, TIE_SCALES[1])
    return _second_round(flight, ground, refit_ground(flight, surface), _RENEWED_STEPS, pictures)


def _step(flight: FlightBlock, surface: GroundModel, ties: MapTies, tie_scale: float) -> None:
    """One Gauss-Newton step with tie points, heights held near the ground."""
    flight.adjustment.step(TRACK_ROBUST_C, surface.height_prior(flight.adjustment.points), ties, tie_scale)


def _second_round(
    flight: FlightBlock, ground: LoadedMap, surface: GroundModel, rounds: int, pictures: Flags | None = None
) -> tuple[GroundModel, MapTies, MapMatches]:
    """New tie points, compared on the ground as the caller has just fitted it, and steps with them."""
    cell_m = _TIE_CELL_SPARSE_M if flight.sparse else _TIE_CELL_M
    matches = tie_matches(flight, surface, ground, cell_m=cell_m, reach_m=TIE_REACH_M, pictures=pictures)
    matches = replace(matches, shift=matches.shift - edge_displacement(flight, surface, ground, matches))
    ties = as_ties(matches, flight.adjustment.points)
    for k in range(rounds):
        _step(flight, surface, ties, TIE_SCALES[min(k, 1)])
        residual = flight.adjustment.tie_residual
        if k in (0, 1) and len(residual) >= _TIE_FEWEST_FOR_SIGMA:  # decimetres on new maps, a metre on old ones
            sigma = float(np.clip(mad_sigma(residual), *_TIE_SIGMA_LIMITS_M))
            ties = replace(ties, sigma_m=np.full(len(ties.point), sigma))
        if k == rounds - 2:
            surface = refit_ground(flight, surface, as_smooth=True)
    return surface, ties, matches


def tie_half_m(flight: FlightBlock) -> float:
    """Half the patch about a tie point, metres: a share of the flying height."""
    return float(np.clip(_TIE_HALF_SHARE * flight.height_m, *_TIE_HALF_LIMITS_M))


def working_gsd(flight: FlightBlock) -> float:
    """Ground pixel in which pictures are compared with each other, metres: about their own."""
    return _PICTURE_GSD_SHARE * flight.height_m / flight.focal_px


def map_gsd(flight: FlightBlock, basemap: MapWindow) -> float:
    """Ground pixel in which pictures are compared with the map, metres: no finer than either of them."""
    picture = flight.height_m / flight.focal_px
    if picture < _MAP_GSD_FINE_M:
        return float(np.clip(max(picture, basemap.native_gsd_m), *_MAP_GSD_M))
    return max(_MAP_GSD_COARSE_M, picture)


@dataclass(frozen=True, slots=True)
class ConfirmedFit:
    """A coarse registration, the map below the flight, and the tie points that confirm it.

    false_matches: expected number of agreements as good as theirs on a map of other ground.
    """

    fit: CoarseFit
    ground: LoadedMap
    matches: MapMatches
    false_matches: float


def confirmed(
    flight: FlightBlock, fits: Iterable[CoarseFit], basemap: MapWindow, origin: Array, surface: GroundModel
) -> ConfirmedFit | None:
    """The first registration that tie points confirm; the cameras then lie there, else where they were."""
    before = flight.adjustment.copy()
    limit, tests = np.log10(FALSE_MATCHES), 0
    cell_m = _FIRST_TIE_CELL_SPARSE_M if flight.sparse else _FIRST_TIE_CELL_M
    for fit in fits:
        shift_cameras(flight, fit.correction)
        ground = load_map(flight, basemap, origin, map_gsd(flight, basemap))
        matches = tie_matches(flight, surface, ground, cell_m=cell_m, reach_m=FIRST_TIE_REACH_M)
        tests += 1  # each test is one more chance to agree
        chance = evidence_log10(flight, matches, tie_half_m(flight)) + np.log10(tests)
        if chance > limit:  # few photos have room for few such patches: more and smaller ones, too noisy as ties
            half_m, tests = _EVIDENCE_SMALL_HALF_M, tests + 1
            small = tie_matches(flight, surface, ground, cell_m=2.0 * half_m, reach_m=FIRST_TIE_REACH_M, half_m=half_m)
            chance = evidence_log10(flight, small, half_m) + np.log10(tests)
        if chance <= limit:
            return ConfirmedFit(fit, ground, matches, float(10.0**chance))
        flight.adjustment = before.copy()
    return None


def evidence_log10(
    flight: FlightBlock, matches: MapMatches, half_m: float, reach_m: float = FIRST_TIE_REACH_M
) -> float:
    """Decimal logarithm of the expected number of false matches behind a flight's tie points.

    matches: its tie points. half_m: half the side of what was compared. reach_m: how far each was searched.
    """
    return false_matches_log10(
        flight.adjustment.points[matches.point, :2],
        matches.shift,
        matches.camera.astype(float),
        leg=flight.leg[matches.camera],
        reach_m=reach_m,
        patch_m=2.0 * half_m,
    )

"""One vehicle's newest pictures, each placed within milliseconds of its arrival.

The vehicle's first pictures are refined together and accepted on the map by evidence (`vehicle_passes`). From then on a
new picture is followed from the one before, some of its points are compared with the map, and the last pictures are
adjusted together. What is older has its last estimate as a prior; the newest ones have their records, corrected by what
the records were off while the map held the vehicle. The work a picture is the same however long the flight is.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Floats, Gray, Indices
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera, ground_jacobian
from orthoswarm.model.errors import AdjustmentError
from orthoswarm.model.frame import UNSTATED_SIGMA_M, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import STATED_SIGMA_FACTOR, MapWindow, PlacedFrame
from orthoswarm.model.robust import mad_sigmas
from orthoswarm.raster.map_cache import TiledMap
from orthoswarm.refine.bundle.adjustment import TRACK_ROBUST_C
from orthoswarm.refine.bundle.block_arrays import CX, CY, HEIGHT, WIDTH, CameraBlock, F, exp_rotation, log_rotation
from orthoswarm.refine.bundle.flight_records import FlightRecords, read_records
from orthoswarm.refine.bundle.normal_equations import room_of_a_point
from orthoswarm.refine.features.tracks import FLOW_SIGMA_PX, Tracker, predicted_homography
from orthoswarm.refine.registration.absolute_orientation import (
    TIE_HALF_PX,
    TIE_HEIGHT_M,
    TIE_REACH_M,
    TIE_REACH_PX,
    TIE_SCALES,
    TIE_SIGMA_M,
    TIE_VIEWS,
    clear_matches,
    map_gsd,
    tie_half_m,
)
from orthoswarm.refine.registration.block_state import VehicleState, full_resolution
from orthoswarm.refine.registration.tie_points import LoadedMap, match_points
from orthoswarm.refine.sequential.window_adjustment import adjust_window

_WINDOW: Final = 12  # pictures that are adjusted together
_NEWEST: Final = 6  # of them those whose records count; what is older has its last estimate
_OLDER_SHARE: Final = 2.5  # sigma of an older picture's estimate, in its own: errors of neighbours are alike
_CELLS: Final = 11  # cells side by side in a picture, a corner is followed in each (16 are no better, 8 a third worse)
_TIES: Final = 12  # points of a picture that are compared with the map (for its time)
_TIE_SLOPE: Final = 0.7
"""Farthest place of such a point from the nadir, over the height: farther out, what stands on the ground displaces it.
"""
_FIRST_SCALE: Final = 100.0  # robust scale before a new picture is adjusted, squared sigmas
_SURE_TIES: Final = 20  # with so many ties in the window the map holds the vehicle
_GUIDE: Final = 8  # pictures whose corrections predict the next one's
_LEAP_M: Final = 5.0  # a record that leaves the flown path by more is an outlier
_HEIGHT_SIGMA_M: Final = 0.3  # least sigma of a corrected height
_TURN_SIGMA_RAD: Final = float(np.radians(0.2))  # least sigma of a corrected attitude
_FLOOR_M: Final = 0.06  # what no residual shows: the map, and what stands on the ground
_BEGUN_M: Final = 0.2  # sigma of the first pictures, refined with ties (0.02 to 0.15 m off in simulation)
_UNHELD_M: Final = 0.08  # growth of the error a picture while the map does not hold the vehicle (0.06 in simulation)
_LOST_M: Final = 5.0  # with a larger sigma the vehicle is lost
_FEWEST_TRACKS: Final = 15  # a picture with fewer corners from the one before is not connected to it
_LEAST_DOWN: Final = 0.3  # least downward part of an optical axis whose error on the ground is told
_MAP_MARGIN_M: Final = 100.0  # the map is taken out of the cache so far around a picture


@dataclass(slots=True, kw_only=True)
class _WindowPicture:
    """A picture of the window: its record and pose in the local frame, its tracks, its sigma on the ground."""

    frame: Frame
    record: Array
    record_rotation: Array
    position: Array
    rotation: Array
    ident: Indices
    uv: Floats
    sigma_m: float


@dataclass(frozen=True, slots=True)
class LivePose:
    """Where a picture was taken, as soon as it is there.

    camera: on the area's grid, lens at full resolution. ground_z_m: level of the ground below. sigma_m: see
    `PlacedFrame`.
    """

    camera: Camera
    ground_z_m: float
    sigma_m: float


class LiveBlock:
    """The newest pictures of one vehicle.

    Args:
        state: its refined first pictures; the newest of them begin the window. Its pictures are read again.
        grid, origin: of the area. basemap: the map on which it was accepted.

    Raises:
        AdjustmentError: the first pictures do not hold together.
    """

    def __init__(self, state: VehicleState, grid: LocalGrid, origin: Array, basemap: MapWindow) -> None:
        flight = state.flight
        self._grid, self._origin, self._surface = grid, origin, state.surface
        self._map_gsd_m, self._half_m = map_gsd(flight, basemap), tie_half_m(flight)
        self._basemap = TiledMap(basemap, self._map_gsd_m)
        self._map: LoadedMap | None = None
        self.size = flight.pictures.size
        cameras = flight.cameras()
        self._lens, self._full_lens = cameras.lens[:1].copy(), full_resolution(cameras, flight).lens[:1].copy()
        self._tracker = Tracker(cell_px=max(1, round(self.size[0] / _CELLS)))
        self._views: list[_WindowPicture] = []
        self._ids, self._points = np.zeros(0, np.int64), np.zeros((0, 3))
        self._seen = np.zeros(0, np.int64)
        self._tie_ids, self._tie_xy, self._tried = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64)
        self._unheld = 0
        records = read_records(flight.frames, grid, origin)
        recorded = records.rotation()
        off = cameras.position - records.position
        turn = log_rotation(np.swapaxes(recorded, 1, 2) @ cameras.rotation)
        self._usual = np.median(off[-_WINDOW:], axis=0), np.median(turn[-_WINDOW:], axis=0)
        for i in range(max(0, len(flight.frames) - _WINDOW), len(flight.frames)):
            pose = cameras.position[i].copy(), cameras.rotation[i].copy()
            view = self._followed(flight.frames[i], flight.pictures.gray(i), records, i, pose)
            view.sigma_m = _BEGUN_M
            self._views.append(view)
            self._add_points()
        self._covariance = np.zeros((6, 6))
        self._adjust(TRACK_ROBUST_C, TRACK_ROBUST_C)
        self._compare(flight.pictures.gray(len(flight.frames) - 1))

    def begun(self, placed: PlacedFrame) -> LivePose:
        """Where one of the first pictures lies."""
        level = float(self._surface.height(placed.camera.nadir[None] - self._origin)[0])
        return LivePose(placed.camera, level, _BEGUN_M)

    @property
    def newest(self) -> Frame:
        """The last picture."""
        return self._views[-1].frame

    def add(self, frame: Frame, gray: Gray) -> LivePose | None:
        """Place the next picture; None where the vehicle is lost: it is to be accepted on the map anew.

        Args:
            frame: later than those before. gray: uint8 (rows, columns), of the size `size`.

        Raises:
            AdjustmentError: the equations cannot be solved.
        """
        records = read_records([*(v.frame for v in self._views[-_GUIDE:]), frame], self._grid, self._origin)
        before = self._views[-1].ident
        view = self._followed(frame, gray, records, -1, self._predicted(records))
        if np.isin(view.ident, before).sum() < _FEWEST_TRACKS:
            return None
        self._views = [*self._views[1 - _WINDOW :], view]
        self._add_points()
        self._adjust(_FIRST_SCALE, TRACK_ROBUST_C)
        if self._compare(gray):
            self._adjust(TRACK_ROBUST_C)
        self._unheld = 0 if len(self._tie_ids) >= _SURE_TIES else self._unheld + 1
        view.sigma_m = self._sigma_m()
        return self._pose(view.position, view.rotation, view.sigma_m) if view.sigma_m < _LOST_M else None

    def near(self, frame: Frame) -> LivePose:
        """Where a picture lies by its record, corrected as those of the window are; it takes no part in the window."""
        records = read_records([*(v.frame for v in self._views[-_GUIDE:]), frame], self._grid, self._origin)
        position, rotation = self._corrected(records)
        return self._pose(position, rotation, float(np.hypot(self._views[-1].sigma_m, UNSTATED_SIGMA_M)))

    def _pose(self, position: Array, rotation: Array, sigma_m: float) -> LivePose:
        block = CameraBlock(position[None], rotation[None], np.zeros(1, np.int32), self._full_lens)
        level = float(self._surface.height(position[None, :2])[0])
        return LivePose(block.camera(0, self._origin), level, sigma_m)

    # -- one picture ----------------------------------------------------------------------------------------------

    def _corrected(self, records: FlightRecords) -> tuple[Array, Array]:
        """Position and attitude of the last record, corrected as those of the newest pictures were."""
        last = self._views[-_GUIDE:]
        off = np.median([v.position - v.record for v in last], axis=0)
        turn = np.median(log_rotation(np.array([v.record_rotation.T @ v.rotation for v in last])), axis=0)
        return records.position[-1] + off, records.rotation()[-1] @ exp_rotation(turn[None])[0]

    def _predicted(self, records: FlightRecords) -> tuple[Array, Array]:
        """Position and attitude of the next picture: its corrected record, or the flown path where that is far off."""
        position, rotation = self._corrected(records)
        if len(self._views) > 1:
            before, last = (view.position for view in self._views[-2:])
            took = np.diff(records.time_s[-3:])
            on = last + (last - before) * np.clip(took[1] / max(took[0], 1e-3), 0, 3)
            if np.hypot(*(on - position)[:2]) > _LEAP_M:
                position = on
        return position, rotation

    def _followed(
        self, frame: Frame, gray: Gray, records: FlightRecords, index: int, pose: tuple[Array, Array]
    ) -> _WindowPicture:
        """A picture with the corners that were followed into it, and new ones."""
        position, rotation = pose
        predicted = None
        if self._views:
            before, lens = self._views[-1], self._lens[0]
            u, v = 0.5 * (lens[WIDTH] - 1) + lens[CX], 0.5 * (lens[HEIGHT] - 1) + lens[CY]
            matrix = np.array([[lens[F], 0.0, u], [0.0, lens[F], v], [0.0, 0.0, 1.0]])
            step = position - before.position
            predicted = predicted_homography(before.rotation, rotation, self._height(before), step, matrix)
        self._tracker.add(0, gray, predicted)
        ident, uv = self._tracker.latest()
        return _WindowPicture(
            frame=frame, record=records.position[index], record_rotation=records.rotation()[index],
            position=position, rotation=rotation, ident=ident, uv=uv, sigma_m=float("nan"),
        )  # fmt: skip

    def _height(self, view: _WindowPicture) -> float:
        return float(view.position[2] - self._surface.height(view.position[None, :2])[0])

    def _cameras(self) -> CameraBlock:
        position, rotation = (np.array([getattr(v, name) for v in self._views]) for name in ("position", "rotation"))
        return CameraBlock(position, rotation, np.zeros(len(self._views), np.int32), self._lens)

    def _add_points(self) -> None:
        """Points of the newest picture's new corners, where it sees the ground; those out of the window go."""
        view, cameras = self._views[-1], self._cameras()
        fresh = ~np.isin(view.ident, self._ids)
        uv = view.uv[fresh].astype(float)
        index = np.full(len(uv), len(cameras) - 1, np.int32)
        z = np.full(len(uv), self._surface.height(view.position[None, :2])[0])
        for _ in range(2):
            xy = cameras.to_ground(index, uv, z)
            z = self._surface.height(np.nan_to_num(xy))
        sure = np.isfinite(xy).all(1)
        self._ids = np.concatenate([self._ids, view.ident[fresh][sure]])
        self._points = np.concatenate([self._points, np.column_stack([xy, z])[sure]])
        there = np.isin(self._ids, np.concatenate([v.ident for v in self._views]))
        self._ids, self._points = self._ids[there], self._points[there]
        tied = np.isin(self._tie_ids, self._ids)
        self._tie_ids, self._tie_xy = self._tie_ids[tied], self._tie_xy[tied]
        self._tried = self._tried[np.isin(self._tried, self._ids)]

    def _adjust(self, *scales: float) -> None:
        """Adjust the window, with a step at each robust scale."""
        views, count = self._views, len(self._ids)
        ident = np.concatenate([v.ident for v in views])
        point = np.searchsorted(self._ids, ident).clip(0, count - 1)
        known = np.flatnonzero(self._ids[point] == ident)
        known = known[np.argsort(point[known], kind="stable")]
        camera = np.repeat(np.arange(len(views), dtype=np.int32), [len(v.ident) for v in views])[known]
        uv, point = np.concatenate([v.uv for v in views]).astype(float)[known], point[known]
        ties = len(self._tie_ids)
        tie_of_point = np.full(count, -1, np.int32)
        tie_of_point[np.searchsorted(self._ids, self._tie_ids)] = np.arange(ties, dtype=np.int32)
        heights, cameras = self._surface.height_prior(self._points), self._cameras()
        weight = np.zeros(len(uv))
        solved = adjust_window(
            cameras.arrays, self._points,
            (np.searchsorted(point, np.arange(count + 1)), camera, uv, np.full(len(uv), FLOW_SIGMA_PX**-2.0)),
            np.arange(len(views), dtype=np.int32), np.array(scales),
            (heights.height, 1.0 / heights.sigma**2, heights.c, 1.0 / heights.soft_sigma**2),
            (tie_of_point, self._tie_xy, np.full(ties, TIE_SIGMA_M**-2.0), TIE_SCALES[-1]),
            self._priors(), room_of_a_point(), (weight, np.zeros((ties, 2)), self._covariance),
        )  # fmt: skip
        if not solved or not np.isfinite(cameras.position).all():
            raise AdjustmentError("the newest pictures do not hold together")
        for i, view in enumerate(views):
            view.position, view.rotation = cameras.position[i], cameras.rotation[i]
        self._seen = np.bincount(point[weight > 0.5], minlength=count)

    def _priors(self) -> tuple[Array, Array, Array, Array]:
        """Position, attitude and their weights before the adjustment, see `adjust_window`."""
        views = self._views
        record, recorded = np.array([v.record for v in views]), np.array([v.record_rotation for v in views])
        off = np.array([v.position for v in views]) - record
        turn = log_rotation(np.swapaxes(recorded, 1, 2) @ np.array([v.rotation for v in views]))
        if len(self._tie_ids) >= _SURE_TIES:
            self._usual = np.median(off[:-1], axis=0), np.median(turn[:-1], axis=0)
        usual, bias = self._usual
        spread = np.maximum(mad_sigmas(off - usual), [UNSTATED_SIGMA_M, UNSTATED_SIGMA_M, _HEIGHT_SIGMA_M])
        scatter = np.maximum(mad_sigmas(turn - bias), _TURN_SIGMA_RAD)
        position, rotation = record + usual, recorded @ exp_rotation(bias[None])[0]
        weight, turning = np.tile(spread**-2.0, (len(views), 1)), np.tile(scatter**-2.0, (len(views), 1))
        older = views[:-_NEWEST]
        if older:
            position[: len(older)], rotation[: len(older)] = [v.position for v in older], [v.rotation for v in older]
            sigma = _OLDER_SHARE * np.array([[v.sigma_m] for v in older])
            weight[: len(older)], turning[: len(older)] = sigma**-2.0, (sigma / self._height(views[-1])) ** -2.0
        return position, weight, rotation, turning

    # -- the map --------------------------------------------------------------------------------------------------

    def _compare(self, gray: Gray) -> int:
        """Compare points of the newest picture with the map, each point once; how many were found."""
        view, ground = self._views[-1], self._loaded_map()
        at = np.searchsorted(self._ids, view.ident).clip(0, len(self._ids) - 1)
        at = at[(self._ids[at] == view.ident) & (self._seen[at] >= TIE_VIEWS) & ~np.isin(self._ids[at], self._tried)]
        level = self._surface.height(self._points[:, :2])
        away = np.hypot(*(self._points[at, :2] - view.position[:2]).T) / (view.position[2] - self._points[at, 2])
        at = at[(away < _TIE_SLOPE) & (np.abs(self._points[at, 2] - level[at]) < TIE_HEIGHT_M)]
        if not len(at):
            return 0
        at = at[spread_points(self._points[at, :2], _TIES)]
        found = clear_matches(
            match_points(
                self._cameras(), self._points, at, camera=np.full(len(self._ids), len(self._views) - 1, np.int32),
                gray=lambda _: gray, ground=ground, half=max(TIE_HALF_PX, round(self._half_m / ground.gsd_m)),
                reach=max(TIE_REACH_PX, round(TIE_REACH_M / ground.gsd_m)), level=level, texture=True,
            )
        )  # fmt: skip
        self._tried = np.concatenate([self._tried, self._ids[at]])
        self._tie_ids = np.concatenate([self._tie_ids, self._ids[found.point]])
        self._tie_xy = np.concatenate([self._tie_xy, self._points[found.point, :2] + found.shift])
        return len(found.point)

    def _loaded_map(self) -> LoadedMap:
        """The map below the newest picture."""
        view, held = self._views[-1], self._map
        half = 0.5 * float(np.hypot(*self.size)) / self._lens[0, F] * self._height(view)
        need = BoundingBox.around_points(view.position[None, :2], half + self._half_m + TIE_REACH_M)
        if held is None or not held.bounds.contains(need):
            held = self._map = LoadedMap.load(self._basemap, self._origin, need.grown(_MAP_MARGIN_M), self._map_gsd_m)
        return held

    def _sigma_m(self) -> float:
        """Sigma of the newest picture's middle on the ground."""
        view = self._views[-1]
        onto = ground_jacobian(view.rotation, self._height(view), _LEAST_DOWN)
        if onto is None:
            return float("inf")
        own = float(np.trace(onto @ self._covariance @ onto.T)) / 2
        return STATED_SIGMA_FACTOR * float(np.sqrt(own + _FLOOR_M**2 + (_UNHELD_M * self._unheld) ** 2))


def spread_points(xy: Array, most: int) -> Indices:
    """At most so many of the points (M, 2): each is the one farthest from those taken before."""
    if len(xy) <= most:
        return np.arange(len(xy))
    chosen = [int(((xy - xy.mean(0)) ** 2).sum(1).argmax())]
    away = ((xy - xy[chosen[0]]) ** 2).sum(1)
    while len(chosen) < most:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, ((xy - xy[chosen[-1]]) ** 2).sum(1))
    return np.array(chosen)

"""The map's location: set by the first picture, extended as pictures arrive, moved if the first was at a wrong place.

The basemap determines the location, else the newest plan, else the majority of the pictures.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from gcs_plugin.daemon.intake.posted_pose import is_position
from gcs_plugin.daemon.layers.layers import MapArea, MapLayer, new_name, successor
from gcs_plugin.daemon.layers.web_tiles import TileServer
from gcs_plugin.daemon.store.daemon_events import AreaChanged, DrawingRestarted, Events
from gcs_plugin.daemon.store.frame_rows import poses_after
from gcs_plugin.daemon.store.journal import (
    Journal,
    all_changes,
    area_forgotten,
    drawn_forgotten,
    fact_change,
    no_change,
)
from gcs_plugin.daemon.store.sortie_rows import solution_paths
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera
from orthoswarm.model.earth import DEGREE_M, distance_m
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid, utm_epsg
from orthoswarm.mosaic.footprint import default_gsd, footprint_boxes, rejection
from orthoswarm.mosaic.realtime import RealtimeMosaic
from orthoswarm.mosaic.recorded_pose import recorded_cameras


@dataclass(frozen=True, slots=True)
class Anchor:
    """The place where pictures are expected.

    Attributes:
        name: for messages: "the basemap". bounds: south, west, north, east in degrees.
    """

    name: str
    bounds: tuple[float, float, float, float]

    @classmethod
    def of_ground(cls, name: str, epsg: int, box: BoundingBox) -> "Anchor":
        """The anchor of a box on a UTM grid."""
        west, south, east, north = box
        ring = LocalGrid(epsg).to_geographic([[west, south], [west, north], [east, south], [east, north]])
        low, high = ring.min(0), ring.max(0)
        return cls(name, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))

    def distance_m(self, lat_deg: float, lon_deg: float) -> float:
        """Distance of a position from the bounds in metres, to a hundredth; 0 inside."""
        south, west, north, east = self.bounds
        middle = 0.5 * (west + east)
        lon_deg = middle + (lon_deg - middle + 180.0) % 360.0 - 180.0
        return distance_m(lat_deg, lon_deg, min(max(lat_deg, south), north), min(max(lon_deg, west), east))


@dataclass(frozen=True, slots=True)
class ExpectedPlace:
    """The location of the map before its first picture.

    Attributes:
        newest_plan: south, west, north, east of the newest plan in degrees, None if there is none.
    """

    tiles: TileServer
    newest_plan: Callable[[], tuple[float, float, float, float] | None]

    def place(self) -> Anchor | None:
        """The basemap, else the newest plan; None if the pictures decide."""
        basemap = self.tiles.basemap
        if basemap is not None:
            return Anchor.of_ground("the basemap", basemap.epsg, basemap.bounds)
        found = self.newest_plan()
        return None if found is None else Anchor("the newest plan", found)


_FEW: Final = 200  # pictures drawn, up to which another ground pixel is chosen anew
_OTHER_GSD: Final = 3.0  # times the map's ground pixel
_FAR_M: Final = 100_000.0
_SEEN_HEIGHTS: Final = 4.0  # nothing is drawn beyond 3.8 heights (`reach`)
_log = logging.getLogger(__name__)


class MapSite:
    """The map's area and the canvas of the real-time layer, used by the drawing thread.

    Attributes:
        area: the map's area, None before the first frame. grid: its grid. mosaic: draws on its canvas.
        layer: the real-time layer. folder: of all layers' canvases.
    """

    def __init__(
        self, journal: Journal, layer: MapLayer, folder: Path, *, gsd_m: float | None, fov_rad: float | None,
        expected: ExpectedPlace, events: Events, memory_mb: float,
    ) -> None:  # fmt: skip
        """Continue where the last daemon stopped.

        Args:
            gsd_m: ground pixel; from the first pictures if None. fov_rad: theta-hat, see recorded_cameras.
            expected: where the map is to lie. events: told when the area changes, and when all is drawn again.
            memory_mb: what the canvas keeps of its tiles.
        """
        self._journal, self.layer, self.folder, self._events = journal, layer, folder, events
        self._gsd_m, self._fov_rad, self._expected, self._memory_mb = gsd_m, fov_rad, expected, memory_mb
        self._positions: list[tuple[float, float]] = []  # of the journal's frames up to the number `_counted`
        self._counted = 0
        self.area: MapArea | None = None
        self.grid: LocalGrid | None = None
        self.mosaic: RealtimeMosaic | None = None
        document = journal.fact("area")
        if document is not None:
            self.area = MapArea.from_document(document)
            self._open(journal.fact("realtime"))

    def place(self, frame: Frame, drawn: int) -> tuple[Camera, float] | str:
        """The frame's camera and sigma in metres, after making room for it on the layer; or why it cannot be drawn."""
        if not is_position({"lat_deg": frame.fix.lat_deg, "lon_deg": frame.fix.lon_deg}):
            return "its receiver had no fix, or has told the same place for too long; nothing tells where it was taken"
        far = self._is_far(frame)
        if far is not None:
            return far
        if self.grid is None:
            if not -80.0 <= frame.fix.lat_deg <= 84.0:
                return "it lies beyond the UTM grid, near a pole"
            epsg = self.area.epsg if self.area else utm_epsg(frame.fix.lat_deg, frame.fix.lon_deg)
            self.grid = LocalGrid(epsg)
        place = self.grid.to_grid(frame.fix.lat_deg, frame.fix.lon_deg)
        if not np.isfinite(place).all():
            return "its position is beyond the map's grid; use a workspace of its own for it"
        placed = recorded_cameras([frame], self.grid, self._fov_rad).placed
        if not placed:
            return "its position is not a number"
        camera = placed[0].camera
        if self.area is None:
            gsd = self._gsd_m or default_gsd([camera])
            reason = rejection(camera, 0.0, gsd)
            if reason is not None:
                self.grid = None
                return reason
            self._begin(MapArea.around(self.grid.epsg, float(place[0]), float(place[1]), gsd))
        elif self._gsd_m is None and drawn < _FEW and self._is_other_scale(camera):
            self._begin_again(camera, place)
        return self._with_room(camera) or (camera, placed[0].sigma_m)

    def _is_far(self, frame: Frame) -> str | None:
        """Why a frame lies too far away for the map, None if it does not; the map may move to it.

        A map started elsewhere (by pictures with a wrong position) is started again, as long as nothing was
        solved on it, and all frames are drawn again.
        """
        fix, anchor = frame.fix, self._expected.place()
        if anchor is not None and anchor.distance_m(fix.lat_deg, fix.lon_deg) > _FAR_M:
            km = anchor.distance_m(fix.lat_deg, fix.lon_deg) / 1e3
            return f"it lies {km:.0f} km from {anchor.name}; check the receiver, or use a workspace of its own for it"
        if self.area is None:
            return None
        lat, lon = _origin_of(self.area)
        away_m = distance_m(fix.lat_deg, fix.lon_deg, lat, lon)
        if away_m <= _FAR_M:
            return None
        wrong = anchor is not None and anchor.distance_m(lat, lon) > _FAR_M
        moves = wrong or (anchor is None and self._is_majority(frame, self.area))
        if moves and not solution_paths(self._journal, "solutions", "coarse"):
            self._move_away()
            return None
        return (
            f"it lies {away_m / 1e3:.0f} km from the others; check the receiver, or use a workspace of its own for it"
        )

    def _is_majority(self, frame: Frame, area: MapArea) -> bool:
        """Whether more frames lie around this one, too far from the map, than around the map's origin.

        All frames of the journal count, drawn or not: while they are drawn again the map would move to and fro.
        """
        for number, pose in poses_after(self._journal, self._counted):
            self._counted = number
            if pose.get("lat_deg") is not None and pose.get("lon_deg") is not None and is_position(pose):
                self._positions.append((pose["lat_deg"], pose["lon_deg"]))
        here = (frame.fix.lat_deg, frame.fix.lon_deg)
        return self._around(here) > self._around(_origin_of(area))

    def _around(self, place: tuple[float, float]) -> int:
        """Number of frames less than a map's reach from a place."""
        near_deg = 1.01 * _FAR_M / DEGREE_M  # of latitude: most others are out of the question
        return sum(
            abs(place[0] - other[0]) <= near_deg and distance_m(*place, *other) <= _FAR_M for other in self._positions
        )

    def _move_away(self) -> None:
        """Drop the map's location: the next frame sets it, and all frames are drawn again."""
        _log.warning("the map was started at a wrong position; it is started again where most pictures lie")
        self._journal.write(area_forgotten)
        self._events.publish(DrawingRestarted())
        self.area, self.grid, self.mosaic = None, None, None
        self.layer.replace(None)

    def _is_other_scale(self, camera: Camera) -> bool:
        """Whether the map's ground pixel was derived from pictures during the climb."""
        assert self.area is not None
        height = float(camera.position[2])
        solved = bool(solution_paths(self._journal, "solutions"))
        return 10.0 < height < 500.0 and not solved and height / camera.lens.focal_px > _OTHER_GSD * self.area.gsd_m

    def _begin_again(self, camera: Camera, place: Any) -> None:
        assert self.grid is not None
        gsd = default_gsd([camera])
        _log.info("the map's pixel becomes %.3f m; what was drawn is drawn again", gsd)
        self._begin(MapArea.around(self.grid.epsg, float(place[0]), float(place[1]), gsd), again=True)

    def _with_room(self, camera: Camera) -> str | None:
        """Extend the layer to a camera's footprint; returns the reason if that is impossible."""
        assert self.area is not None
        east, north, height = (float(v) for v in camera.position)
        far = _SEEN_HEIGHTS * abs(height)
        if self.area.bounds.contains(BoundingBox(east, north, east, north).grown(far)):
            return None  # the usual case, without a look at the footprint
        if rejection(camera, 0.0, self.area.gsd_m) is not None:
            return None  # the mosaic reports that
        box = footprint_boxes([camera], 0.0, 0.0)[0]
        bounds = BoundingBox(*(float(v) for v in box))
        if not np.isfinite(box).all() or self.area.bounds.contains(bounds):
            return None
        try:
            area = self.area.grown(bounds)
        except OrthoSwarmError as error:
            return str(error)
        old = self.layer.canvas
        name = new_name("realtime")
        path, memory_mb = self.folder / name, self._memory_mb
        self._adopt(area, successor(old, path, area.grid, "orthogonality", share=True, memory_mb=memory_mb))
        return None

    # -- the layer ------------------------------------------------------------------------------------------------

    def _begin(self, area: MapArea, *, again: bool = False) -> None:
        canvas = Canvas.create(self.folder / new_name("realtime"), area.grid, memory_mb=self._memory_mb)
        self._adopt(area, canvas, again=again)

    def _adopt(self, area: MapArea, canvas: Canvas, *, again: bool = False) -> None:
        """Make a canvas the layer, in the journal first."""
        facts = [fact_change("area", area.document()), fact_change("realtime", canvas.path.name)]
        self._journal.write(all_changes(*facts, drawn_forgotten if again else no_change))
        if again:
            self._events.publish(DrawingRestarted())
        self.area = area
        self.layer.replace(canvas)
        self.mosaic = RealtimeMosaic(canvas)
        self.grid = LocalGrid(area.epsg)
        self._events.publish(AreaChanged(area.epsg))

    def _open(self, name: str | None) -> None:
        """The canvas that the last daemon drew on; drawn anew from the journal if it is damaged."""
        assert self.area is not None
        try:
            canvas = Canvas.open(self.folder / str(name), memory_mb=self._memory_mb)
        except (OrthoSwarmError, OSError):
            _log.warning("the real-time layer is damaged and is drawn again")
            self._begin(self.area, again=True)
            return
        self.layer.replace(canvas)
        self.mosaic = RealtimeMosaic(canvas)
        self.grid = LocalGrid(self.area.epsg)
        self._events.publish(AreaChanged(self.area.epsg))


@lru_cache(maxsize=8)
def _origin_of(area: MapArea) -> tuple[float, float]:
    """Latitude and longitude of an area's origin, degrees."""
    lat, lon = LocalGrid(area.epsg).to_geographic(area.origin)
    return float(lat), float(lon)

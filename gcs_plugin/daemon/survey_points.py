"""Surveyed points that people mark in pictures on the page, and how well the pictures' places fit them.

A point's table is read as those of `mosaic --control` are. Where a picture should show a point follows from the
picture's place; where it does is marked. What is marked is written as ODM's gcp_list.txt.
"""

import tempfile
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np

from gcs_plugin.daemon.exports import Exports, SightingRow
from gcs_plugin.daemon.store.console_state import number_in
from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.frame_rows import FrameRow, all_frames
from gcs_plugin.daemon.store.journal import Journal
from orthoswarm.control.control_observations import pixel_ray
from orthoswarm.evaluation.checkpoints import RECEIVERS_LOCAL_SIGMA_M, SAME_PLACE_M, Mark, read_checkpoints
from orthoswarm.evaluation.misread_points import away_m
from orthoswarm.evaluation.point_rays import intersect_rays, intersection
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame

_MOST_POINTS: Final = 1000
_MOST_PX: Final = 1e6  # of a side of a picture


class MarkRow(TypedDict):
    """Where a picture (`seq`, `vehicle`, `image`) shows a point, pixels; `off_px`: from where all marks put it."""

    seq: int
    vehicle: str
    image: str
    column: float
    row: float
    off_px: float | None


class PointRow(TypedDict):
    """A surveyed point.

    marks: where it was marked. off_m: east and north from the survey to where the marks put it. rays_miss_m: root mean
    square by which their rays miss each other. Both are null without marks in pictures that have a place, the last with
    fewer than two. findings: what is wrong with the marks.
    """

    name: str
    lat_deg: float
    lon_deg: float
    marks: list[MarkRow]
    off_m: list[float] | None
    rays_miss_m: float | None
    findings: list[str]


class SurveyPoints:
    """The points and their marks, in the journal; `exports`: knows where the pictures are."""

    def __init__(self, journal: Journal, events: Events, exports: Exports) -> None:
        self._journal, self._events, self._exports = journal, events, exports
        self._lock = threading.Lock()

    def rows(self) -> list[PointRow]:
        """The points in the order of their table."""
        found = [
            PointRow(
                name=point["name"], lat_deg=point["lat_deg"], lon_deg=point["lon_deg"],
                marks=[*point["marks"].values()], off_m=None, rays_miss_m=None, findings=[],
            )
            for point in self._points()
        ]  # fmt: skip
        if any(row["marks"] for row in found):
            frames, level, grid = self._exports.placed()
            placed = {(p.frame.vehicle, p.frame.image): p for p in frames}
            for row in found:
                _measure(row, placed, level, grid)
        return found

    def load(self, table: bytes) -> list[PointRow]:
        """Replace the points by those of a table (gcp_list.txt or CSV, see evaluation.checkpoints).

        Marks of points that are in both stay; those of the table are taken where a picture has that name.

        Raises:
            InputError: it cannot be read, holds too many, or marks a point outside its picture.
        """
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "the table"
            path.write_bytes(table)
            read = read_checkpoints(path)
        if len(read) > _MOST_POINTS:
            raise InputError(f"the table holds {len(read)} points; send at most {_MOST_POINTS}")
        frames = dict(self._named()) if any(p.marks for p in read) else {}
        with self._lock:
            known = {point["name"]: point for point in self._points()}
            points = []
            for point in read:
                marks = dict(_stored(frames[m.image], m) for m in point.marks if m.image in frames)
                lon, lat = (float(v) for v in point.surveyed)
                old = known.get(point.name, {"lon_deg": np.inf, "lat_deg": np.inf, "marks": {}})
                if away_m(np.array([old["lon_deg"], old["lat_deg"]]), point.surveyed) < SAME_PLACE_M:  # read again
                    marks = old["marks"] | marks
                points.append({"name": point.name, "lat_deg": lat, "lon_deg": lon, "marks": marks})
            self._journal.remember("points", points)
        self._events.tell("points")
        return self.rows()

    def _named(self) -> list[tuple[str, FrameRow]]:
        """What a table calls each picture: its name, with the vehicle as folder where several have it."""
        rows = list(all_frames(self._journal))
        count = Counter(row.image for row in rows)
        return [(row.image if count[row.image] == 1 else f"{row.vehicle}/{row.image}", row) for row in rows]

    def mark(self, body: Mapping[str, Any]) -> list[PointRow]:
        """Mark a point (`name`) in a picture (`seq`) at `column` and `row`, or not any more where these are null.

        Raises:
            InputError: there is no such point or picture, or the mark lies outside it.
        """
        seq, away = body.get("seq"), body.get("column") is None and body.get("row") is None
        frame = next((row for row in all_frames(self._journal) if row.seq == seq), None)
        if frame is None:
            raise InputError(f"there is no picture {seq}; see /api/frames")
        with self._lock:
            points = self._points()
            point = next((point for point in points if point["name"] == body.get("name")), None)
            if point is None:
                raise InputError(f"there is no point {body.get('name')}; see /api/points")
            if away:
                point["marks"].pop(str(seq), None)
            else:
                column, line = (number_in(body, key, _MOST_PX) for key in ("column", "row"))
                point["marks"] |= [_stored(frame, Mark(frame.image, column, line))]
            self._journal.remember("points", points)
        self._events.tell("points")
        return self.rows()

    def pictures(self, name: str) -> list[SightingRow]:
        """The pictures that show a point, best first, see `SightingRow`. Raises InputError: there is no such point."""
        point = next((point for point in self._points() if point["name"] == name), None)
        if point is None:
            raise InputError(f"there is no point {name}; see /api/points")
        return self._exports.pictures_of(point["lat_deg"], point["lon_deg"])

    def gcp_list(self) -> str:
        """The marks as ODM's gcp_list.txt; heights are not known.

        Raises:
            InputError: a picture's name has a blank, which ends a name there.
        """
        names = {row.seq: name for name, row in self._named()}
        marks = [(row, mark, names[mark["seq"]]) for row in self.rows() for mark in row["marks"]]
        if blank := next((name for *_, name in marks if len(name.split()) != 1), None):
            raise InputError(f"{blank} has a blank in its name, which gcp_list.txt cannot hold; take away its mark")
        lines = [
            f"{row['lon_deg']:.9f} {row['lat_deg']:.9f} NaN {mark['column']:.2f} {mark['row']:.2f} {name} "
            + "_".join(row["name"].split())
            for row, mark, name in marks
        ]
        return "\n".join(["EPSG:4326", *lines, ""])

    def _points(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self._journal.fact("points") or []
        return found


def _stored(frame: FrameRow, mark: Mark) -> tuple[str, MarkRow]:
    """A mark as the journal has it, by the picture's number. Raises InputError: it lies outside the picture."""
    mark.check_inside(*frame.size)
    row = MarkRow(
        seq=frame.seq, vehicle=frame.vehicle, image=frame.image, column=mark.column, row=mark.row, off_px=None
    )
    return str(frame.seq), row


def _measure(row: PointRow, placed: Mapping[tuple[str, str], PlacedFrame], level: float, grid: LocalGrid) -> None:
    """Fill in what the marks say of a point; level: of the ground, metres."""
    seen = [(mark, p) for mark in row["marks"] if (p := placed.get((mark["vehicle"], mark["image"]))) is not None]
    if not seen:
        return
    rays = [
        pixel_ray(p, np.array([mark["column"], mark["row"]]), p.sigma_m or RECEIVERS_LOCAL_SIGMA_M) for mark, p in seen
    ]
    met = intersect_rays(rays, level)
    off = met.place - grid.to_grid(row["lat_deg"], row["lon_deg"])
    row["off_m"], row["findings"] = [round(float(v), 3) for v in off], met.findings(row["name"])
    if len(seen) < 2:
        return
    row["rays_miss_m"] = round(met.miss_m, 3)
    place = intersection([(ray.position, ray.direction) for ray in rays], level)
    for mark, p in seen:
        u, v = p.camera.project(place[None])[0].tolist()
        mark["off_px"] = round(float(np.hypot(u - mark["column"], v - mark["row"])), 2)

"""Checks of plans that share nothing with the planner: missions are read and flown by other code."""

import json
from dataclasses import dataclass

import numpy as np
import shapely

from orthoswarm.model.geo import LocalGrid
from orthoswarm.planning.area.shape_files import Polygon

GRID = LocalGrid(32632)
ORIGIN = np.array([500_000.0, 5_300_000.0])
RTL, LAND, WAYPOINT, TAKEOFF, TRIGGER = 20, 21, 16, 22, 206


def on_globe(shell, holes=()) -> Polygon:
    """A polygon in metres from a place in UTM 32N as latitudes and longitudes."""

    def turn(ring):
        return GRID.to_geographic(np.asarray(ring, float) + ORIGIN)

    return Polygon(turn(shell), tuple(turn(hole) for hole in holes))


def to_metres(lat_lon):
    lat_lon = np.asarray(lat_lon, float).reshape(-1, 2)
    return GRID.to_grid(lat_lon[:, 0], lat_lon[:, 1]) - ORIGIN


def write_geojson(path, polygon: Polygon):
    def closed(ring):
        return [[float(lon), float(lat)] for lat, lon in [*ring, ring[0]]]

    rings = [closed(polygon.shell), *(closed(hole) for hole in polygon.holes)]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": rings}))
    return path


@dataclass
class Flown:
    """What a mission does: the whole path, and the legs with the distance between pictures."""

    path: np.ndarray
    heights: np.ndarray
    legs: list
    distances: list

    @property
    def length_m(self):
        return float(np.hypot(*np.diff(self.path, axis=0).T).sum())


def fly(waypoints_text: str) -> Flown:
    """Interpret a .waypoints file line by line."""
    head, *lines = waypoints_text.splitlines()
    assert head == "QGC WPL 110"
    rows = [[float(v) for v in line.split("\t")] for line in lines]
    assert [int(r[0]) for r in rows] == list(range(len(rows)))
    home = rows[0][8:10]
    path, heights, legs, distances = [home], [0.0], [], []
    begin = None
    for r in rows[1:]:
        command = int(r[3])
        if command in (WAYPOINT, TAKEOFF, LAND):
            path.append(r[8:10])
            heights.append(r[10])
        elif command == RTL:
            path.append(home)
            heights.append(0.0)
        elif command == TRIGGER:
            here = to_metres(path[-1])[0]
            if r[4] > 0:
                assert begin is None
                begin = (here, r[4], len(path))
            else:
                assert begin is not None
                assert len(path) == begin[2] + 1, "a leg has a bend"
                legs.append(np.stack([begin[0], here]))
                distances.append(begin[1])
                begin = None
    assert begin is None, "the camera is left on"
    return Flown(to_metres(path), np.array(heights), legs, distances)


def seen_by(flown: Flown, width: float, height: float):
    """Union of the pictures on the legs: one at each leg's start, then one every trigger distance.

    Pictures that overlap along the leg make one rectangle.
    """
    seen = []
    for leg, distance in zip(flown.legs, flown.distances, strict=True):
        assert distance <= height
        length = np.hypot(*(leg[1] - leg[0]))
        along = (leg[1] - leg[0]) / length
        across = 0.5 * width * np.array([-along[1], along[0]])
        first = leg[0] - 0.5 * height * along
        last = leg[0] + (np.floor(length / distance + 1e-6) * distance + 0.5 * height) * along
        seen.append(shapely.Polygon([first + across, last + across, last - across, first - across]))
    return shapely.union_all(seen)


def crossed(flown: Flown, holes) -> float:
    """Metres of the path inside holes."""
    zones = shapely.union_all([shapely.Polygon(hole) for hole in holes])
    return float(shapely.LineString(flown.path).intersection(zones).length)

"""Accuracy at surveyed points, stated as ASPRS's Positional Accuracy Standards (edition 2, 2023) ask for.

A point is measured in the photos that show it (its rays are intersected) or on the orthoimage; the differences to the
survey are summed up as root mean squares, to which the survey's own error belongs. Two files are read:

- ODM's gcp_list.txt: a line with the coordinate system, then `east north height column row image [name]`.
- CSV with a header, separated by commas or semicolons: `name`; `lat_deg`,`lon_deg`, or `east_m`,`north_m` with `epsg`;
  `sigma_m` (of the survey, an axis); then either `image`,`column`,`row`, a line a photo, or `map_lat_deg`,`map_lon_deg`
  or `map_east_m`,`map_north_m`, the place at which the orthoimage shows the point.
"""

import csv
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.evaluation.misread_points import FARTHEST_M, Coordinates, away_m, doubts, misplaced
from orthoswarm.evaluation.photo_names import photo_named
from orthoswarm.evaluation.point_rays import Ray, RayPoint, intersect_rays
from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Lens, focal_px
from orthoswarm.model.coordinate_system import to_degrees
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, area_epsg

STANDARD_COUNT = 30  # checkpoints that a statement by the standard needs at least
SAME_PLACE_M = 0.02  # lines of one point may round its coordinates differently
_DECIMAL_COMMA = re.compile(r"^([-+]?\d+),(\d+)$")

SURVEY_SIGMA_M: Final = 0.05
"""Sigma of a surveyed position, an axis, where its file states none: a network receiver's. Where there are enough
points to see how far they really scatter, that counts instead if it is more."""
POINTING_SIGMA_PX: Final = 1.0  # sigma of a point's place in a photo; photos of a point count as independent
RECEIVERS_LOCAL_SIGMA_M: Final = 0.4
"""How far a block without a map is bent besides shift, turn and scale, one sigma an axis. Measured on the same photos:
0.31 m are left at five points after four unknowns; 73 to 80 % of the points that took no part lie within one stated
sigma and 90 to 100 % within two."""
_ONE_PLACE_M: Final = 0.05  # checkpoint within this distance of a control point is that point (as surveys differ) ...
_SAME_NAME_M: Final = 10.0  # ... and within this one if it has its name


@dataclass(frozen=True, slots=True)
class Mark:
    """A point seen in a photo: column and row, pixel centres at integers, in pixels of the photo as it was mapped."""

    image: str
    column: float
    row: float

    def check_inside(self, width: int, height: int) -> None:
        """Refuse a mark outside its photo. Raises InputError: it lies more than a pixel outside."""
        if not (-1.0 <= self.column <= width and -1.0 <= self.row <= height):
            raise InputError(
                f"{self.image} has {width} x {height} pixels, a point is marked at {self.column:.0f}, {self.row:.0f}; "
                "if the points were measured in larger copies, say how much smaller these are (--pixel-scale 0.2)"
            )


@dataclass(slots=True)
class Checkpoint:
    """A surveyed point."""

    name: str  # of the point
    surveyed: Array  # float64 (2,), longitude and latitude (WGS 84)
    sigma_m: float = 0.0  # of the survey, an axis; 0 where it is not stated
    marks: list[Mark] = field(default_factory=list)  # where photos show it
    on_map: Array | None = None  # longitude and latitude at which the orthoimage shows it
    _: KW_ONLY
    written: Coordinates | None = None  # its coordinates as the table has them
    doubt: str = ""  # what is uncertain about their datum, "" if nothing is


@dataclass(frozen=True, slots=True)
class CheckpointAccuracy:
    """What the checkpoints say."""

    names: list[str]  # of the points that could be measured
    error: Array  # float64 (n, 2), map minus survey, east and north, metres
    survey_m: float  # root mean square of the survey's own horizontal error, metres
    unused: list[str]  # names of the points that no mapped photo shows, and of those that lie elsewhere
    how: str  # `photos`, `orthoimage` or both
    _: KW_ONLY
    # names of the points that were left out because they had placed the map
    control: list[str] = field(default_factory=list)
    # marks that contradict each other, points that cannot be where they are said to be, and what is uncertain about
    # their datum, in plain words
    findings: list[str] = field(default_factory=list)
    # root mean square by which the rays of each point miss it, metres; None where it was measured on the orthoimage
    miss_m: list[float | None] = field(default_factory=list)

    @property
    def rmse(self) -> tuple[float, float]:
        """Root mean square error east and north, metres."""
        east, north = np.sqrt((self.error**2).mean(axis=0)).tolist()
        return east, north

    @property
    def rmse_h_m(self) -> float:
        """Horizontal root mean square error of the fit to the points, metres."""
        return math.hypot(*self.rmse)

    def statement(self) -> str:
        """The standard's sentence, or why it cannot be said."""
        total = math.hypot(self.rmse_h_m, self.survey_m)
        tested = f"RMSE_H = {total:.2f} m at {len(self.names)} checkpoints, survey's error included"
        if len(self.names) < STANDARD_COUNT:
            return f"{tested}; a statement by the ASPRS standard (edition 2, 2023) needs at least {STANDARD_COUNT}"
        return f"tested by the ASPRS Positional Accuracy Standards, edition 2 (2023): {tested}"

    def figures(self) -> dict[str, Any]:
        """As JSON values."""
        east, north = self.rmse
        mean = self.error.mean(axis=0)
        away = np.hypot(*self.error.T)
        return {
            "checkpoints": len(self.names),
            "rmse_e_m": east,
            "rmse_n_m": north,
            "rmse_h_m": self.rmse_h_m,
            "survey_rmse_h_m": self.survey_m,
            "mean_e_m": float(mean[0]),
            "mean_n_m": float(mean[1]),
            "max_h_m": float(away.max()),
            "measured_in": self.how,
            "statement": self.statement(),
            "unused": self.unused,
            "control_left_out": self.control,
            "findings": self.findings,
            "points": [
                {"name": n, "east_m": float(e), "north_m": float(v), "rays_miss_m": miss}
                for n, (e, v), miss in zip(self.names, self.error, self.miss_m)
            ],
        }


def evaluate_checkpoints(
    out: Path, table: Path, pixel_scale: float = 1.0, ground_z_m: float | None = None, *,
    control: Sequence[Checkpoint] | None = None,
) -> CheckpointAccuracy:  # fmt: skip
    """Errors of a product at surveyed points.

    Args:
        out: output folder of `mosaic` (or the workspace of a daemon), or a file in it.
        table: the points, see the module.
        pixel_scale: pixels of the mapped photos to one of the photos in which the points were measured.
        ground_z_m: level of the homographies, None to read it from report.json.
        control: points that placed the map and do not count, None to read them from report.json.

    Raises:
        InputError: if the table cannot be read, no point of it can be measured, or all lie elsewhere.
    """
    folder = out if out.is_dir() else out.parent
    every = read_checkpoints(table, pixel_scale)
    shared = shared_points(every, _control_of(folder) if control is None else control, table.name)
    points = [point for point in every if point.name not in shared]
    views = _Views.read(folder, ground_z_m) if any(p.marks for p in points) else None
    lat_lon = [(p.surveyed if p.on_map is None else p.on_map)[::-1] for p in points]
    grid = LocalGrid(views.epsg if views else area_epsg(*np.array(lat_lon, float).T))
    names, errors, sigmas, unused, how = [], [], [], [], set()
    findings = list(dict.fromkeys(f"points: {point.doubt}" for point in points if point.doubt))
    misses: list[float | None] = []
    elsewhere: list[tuple[str, Coordinates | None, Array, Array]] = []
    for point in points:
        met = views.point(point.marks) if views else None
        if met is not None:
            found = met.place
            findings += met.findings(point.name)
            how.add("photos")
        elif point.on_map is not None:
            found = _placed(grid, point.on_map)
            how.add("orthoimage")
        else:
            unused.append(point.name)
            continue
        seen = grid.to_geographic(found)[::-1]
        if away_m(point.surveyed, seen) > FARTHEST_M:
            elsewhere.append((point.name, point.written, point.surveyed, seen))
            continue
        names.append(point.name)
        misses.append(None if met is None else met.miss_m)
        errors.append(found - _placed(grid, point.surveyed))
        sigmas.append(point.sigma_m)
    if elsewhere and not names:
        raise InputError(f"{table.name}: {misplaced(elsewhere)}")
    if not names:
        raise InputError(
            f"none of the {len(points)} points of {table.name} is seen in a mapped photo; check the names of the images"
        )
    survey = float(np.sqrt(2.0 * np.mean(np.square(sigmas))))
    measured_in = " and ".join(sorted(how))
    if elsewhere:
        unused += [name for name, *_ in elsewhere]
        findings.append(f"points: {misplaced(elsewhere)}")
    findings += doubts(names, np.array(errors))
    return CheckpointAccuracy(
        names, np.array(errors), survey, unused, measured_in, control=shared, findings=findings, miss_m=misses
    )


def _control_of(folder: Path) -> Sequence[Checkpoint]:
    """The control points of a map; none where it has no report that can be read (see _Views.read for its message)."""
    try:
        rows = json.loads((folder / "report.json").read_text("utf-8")).get("control_points") or []
        return [Checkpoint(str(row["name"]), np.array([row["lon_deg"], row["lat_deg"]], float)) for row in rows]
    except (OSError, ValueError, AttributeError, KeyError, TypeError):
        return []


def read_checkpoints(table: Path, pixel_scale: float = 1.0) -> list[Checkpoint]:
    """The points of a table, see the module. Raises InputError: if it cannot be read, with the line."""
    try:
        lines = table.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the checkpoints {table} cannot be read ({error})") from None
    lines = [line for line in lines if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{table.name} holds no points")
    separator = max(";,", key=lines[0].count)
    try:
        if separator not in lines[0]:
            points = _gcp_list(lines, table.name, pixel_scale)
        else:
            points = _csv(lines, table.name, pixel_scale, separator)
    except csv.Error as error:
        raise InputError(f"{table.name} is no table ({error}); export it again") from None
    if not points:
        raise InputError(f"{table.name} holds no points below its first line")
    return points


def _mark(scale: float, image: str, column: float, row: float) -> Mark:
    """A mark in the mapped photo; scale: its pixels to one of the photo in which the point was measured."""
    return Mark(image, (column + 0.5) * scale - 0.5, (row + 0.5) * scale - 0.5)


def _gcp_list(lines: Sequence[str], name: str, scale: float) -> list[Checkpoint]:
    """ODM's gcp_list.txt; lines with the same coordinates, and name if there are names, are one point."""
    system = lines[0].strip()
    points: list[Checkpoint] = []
    for number, line in enumerate(lines[1:], 2):
        words = line.split()
        try:
            east, north, column, row = (_number(words[i]) for i in (0, 1, 3, 4))
            float(words[2])  # a height, which is not used; ODM writes NaN where there is none
            image = words[5]
        except (ValueError, IndexError):
            raise InputError(f"{name}, line {number}: expected 'east north height column row image [name]'") from None
        key = words[6] if len(words) > 6 else f"{words[0]} {words[1]}"
        written = Coordinates(east, north, system)
        place, doubt = _in_degrees(written, name)
        marks = [_mark(scale, image, column, row)]
        points.append(Checkpoint(key, place, marks=marks, written=written, doubt=doubt))
    return _merged(points)


def _csv(lines: Sequence[str], name: str, scale: float, separator: str) -> list[Checkpoint]:
    points: list[Checkpoint] = []
    for number, row in enumerate(csv.DictReader(lines, skipinitialspace=True, delimiter=separator), 2):
        cells = {(key or "").strip().lower(): (value or "").strip() for key, value in row.items() if key is not None}
        if separator == ";":  # spreadsheets in many countries write decimal commas then
            cells = {key: _DECIMAL_COMMA.sub(r"\1.\2", value) for key, value in cells.items()}
        try:
            written = _coordinates(cells, "")
            if written is None:
                raise KeyError("it has no coordinates")
            sigma_m = _number(cells.get("sigma_m") or "0")
            if sigma_m < 0.0:
                raise ValueError(f"sigma_m is {sigma_m:g}, but cannot be less than 0")
            surveyed, doubt = _in_degrees(written, name)
            shown = _coordinates(cells, "map_")
            on_map = None if shown is None else _in_degrees(shown, name)[0]
            title = cells.get("name") or f"{surveyed[1]:.7f} {surveyed[0]:.7f}"
            point = Checkpoint(title, surveyed, sigma_m, on_map=on_map, written=written, doubt=doubt)
            if cells.get("image"):
                point.marks.append(_mark(scale, cells["image"], _number(cells["column"]), _number(cells["row"])))
        except (KeyError, ValueError) as error:
            reason = f"column {error} is missing" if isinstance(error, KeyError) else str(error)
            raise InputError(
                f"{name}, line {number}: {reason}; columns are name, lat_deg, lon_deg (or east_m, north_m, "
                "epsg), sigma_m, and image, column, row (or map_lat_deg, map_lon_deg)"
            ) from None
        points.append(point)
    return _merged(points)


def _merged(lines: Iterable[Checkpoint]) -> list[Checkpoint]:
    """Points of the same name and place as one; those of one name at several places told apart by a number."""
    places: dict[str, list[Checkpoint]] = {}
    points: list[Checkpoint] = []
    for line in lines:
        same_name = places.setdefault(line.name, [])
        known = next(
            (p for p in same_name if p.written == line.written or away_m(p.surveyed, line.surveyed) <= SAME_PLACE_M),
            None,
        )
        if known is None:
            same_name.append(line)
            points.append(line)
        else:
            known.marks += line.marks
            known.on_map = line.on_map if known.on_map is None else known.on_map
    for name, several in places.items():
        for number, point in enumerate(several if len(several) > 1 else (), 1):
            point.name = f"{name} ({number})"
    return points


def _coordinates(cells: Mapping[str, str], prefix: str) -> Coordinates | None:
    """A place by a row's columns with a prefix; None where they are not there."""
    if cells.get(f"{prefix}lat_deg") and cells.get(f"{prefix}lon_deg"):
        return Coordinates(_number(cells[f"{prefix}lon_deg"]), _number(cells[f"{prefix}lat_deg"]), "EPSG:4326")
    if cells.get(f"{prefix}east_m") and cells.get(f"{prefix}north_m"):
        system = f"EPSG:{int(cells['epsg'])}"
        return Coordinates(_number(cells[f"{prefix}east_m"]), _number(cells[f"{prefix}north_m"]), system)
    return None


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"'{text}' is not a number")
    return value


def _in_degrees(written: Coordinates, name: str) -> tuple[Array, str]:
    """Longitude and latitude (2,) of coordinates as ODM and users write them, and a doubt about their datum."""
    try:
        return to_degrees(written.system, written.x, written.y)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _placed(grid: LocalGrid, lon_lat: Array) -> Array:
    return grid.to_grid(lon_lat[1], lon_lat[0])


@dataclass(frozen=True, slots=True)
class _Views:
    """The mapped photos of a product, by name."""

    rows: dict[str, dict[str, Any]]  # lines of frames.jsonl by image
    epsg: int
    ground_z_m: float  # level of their homographies

    @classmethod
    def read(cls, folder: Path, ground_z_m: float | None) -> "_Views":
        """Raises InputError if the folder has no placed frames."""
        try:
            text = (folder / "frames.jsonl").read_text("utf-8")
            if ground_z_m is None:
                ground_z_m = float(json.loads((folder / "report.json").read_text("utf-8")).get("ground_z_m") or 0.0)
            rows = [json.loads(line) for line in text.splitlines() if line.strip()]
        except (OSError, ValueError) as error:
            raise InputError(
                f"{folder} has no frames.jsonl and report.json that can be read ({error}); give the output folder of "
                "`orthoswarm mosaic`"
            ) from None
        placed = {r["image"].replace("\\", "/"): r for r in rows if r.get("homography") and r.get("camera")}
        if not placed:
            raise InputError(f"{folder} has no placed photos")
        return cls(placed, int(next(iter(placed.values()))["epsg"]), ground_z_m)

    def point(self, marks: Sequence[Mark]) -> RayPoint | None:
        """Where the rays of marks meet; None if none of their photos was mapped."""
        found = ((self._row(mark.image), mark) for mark in marks)
        rays = [self._ray(row, mark) for row, mark in found if row is not None]
        return intersect_rays(rays, self.ground_z_m) if rays else None

    def _row(self, image: str) -> dict[str, Any] | None:
        name = photo_named(self.rows, image)
        return None if name is None else self.rows[name]

    def _ray(self, row: Mapping[str, Any], mark: Mark) -> Ray:
        width, height = int(row["width"]), int(row["height"])
        mark.check_inside(width, height)
        focal = focal_px(math.radians(float(row["fov_deg"])), width)
        lens = Lens(width, height, focal, k1=float(row.get("k1", 0.0)), k2=float(row.get("k2", 0.0)))
        centre = np.array(lens.principal_point)
        pixel = lens.undistort((np.array([mark.column, mark.row]) - centre) / focal) * focal + centre
        h = np.array(row["homography"]) @ np.array([*pixel, 1.0])
        ground = np.array([*(h[:2] / h[2]), self.ground_z_m])
        camera = row["camera"]
        place = LocalGrid(self.epsg).to_grid(camera["lat_deg"], camera["lon_deg"])
        position = np.array([*place, float(camera["height_m"])])
        away = ground - position
        # The sigma of photos that lie where receivers say has mostly what is common to all of them.
        own = RECEIVERS_LOCAL_SIGMA_M if row["stage"] == "coarse" else row.get("sigma_m")
        pixel_rad = POINTING_SIGMA_PX / focal
        return Ray(row["image"], position, away / np.linalg.norm(away), pixel_rad, float(own or 0.0))


def control_rows(points: Iterable[Checkpoint]) -> list[dict[str, Any]]:
    """`control_points` of report.json."""
    return [
        {"name": point.name, "lat_deg": float(point.surveyed[1]), "lon_deg": float(point.surveyed[0])}
        for point in points
    ]


def shared_points(checkpoints: Sequence[Checkpoint], control: Sequence[Checkpoint], table: str) -> list[str]:
    """Names of the checkpoints that are control points: at the same place, or near by with the same name.

    A name alone does not tell: many a table counts its points from 1. Raises InputError: all of the `table` are.
    """

    def same(point: Checkpoint, other: Checkpoint) -> bool:
        away = away_m(point.surveyed, other.surveyed)
        return away <= (_SAME_NAME_M if point.name == other.name else _ONE_PLACE_M)

    shared = [point.name for point in checkpoints if any(same(point, other) for other in control)]
    if checkpoints and len(shared) == len(checkpoints):
        raise InputError(
            f"all points of {table} are control points, which tell nothing about the map's error; keep some points out "
            "of --control and give these to --checkpoints"
        )
    return shared


def shared_warning(shared: Sequence[str], count: int) -> list[str]:
    """What a run says about checkpoints that do not count; nothing where all do."""
    if not shared:
        return []
    names = ", ".join(shared[:5]) + (", ..." if len(shared) > 5 else "")
    return [
        f"{len(shared)} of {count} checkpoints were left out, as they are control points ({names}): the map was placed "
        "on them"
    ]

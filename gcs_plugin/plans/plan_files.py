"""A plan as files: a mission per vehicle and sortie, one GeoJSON of all, a report, a picture, and their folder."""

import io
import json
import math
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from gcs_plugin.mission.makers.maker_files import MAKERS, maker_file
from gcs_plugin.mission.mission_files import Autopilot, plan_text, sortie_items, waypoints_text
from gcs_plugin.plans.plan_request import PlanRequest, flown_by, sortie_path
from orthoswarm.config import changes
from orthoswarm.coverage.gaps import PlannedFlight
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.plan import OverGround, Plan, Sortie, VehiclePlan
from orthoswarm.planning.area.area import Area

MISSION_SUFFIXES = (".plan", ".waypoints")
REPORT = "plan.json"
_INCHES = 10.0  # of the longer side
_LABELS = 24  # vehicles that are named in the legend


def sortie_name(vehicle: VehiclePlan, index: int) -> str:
    """Name of a sortie's files without suffix: v3, or v3-sortie2 where a vehicle flies several."""
    return vehicle.id if len(vehicle.sorties) == 1 else f"{vehicle.id}-sortie{index + 1}"


def mission_files(plan: Plan, autopilots: Sequence[str]) -> dict[str, str | bytes]:
    """All mission files by name, in the dialects that the vehicles are given in turn.

    A vehicle that a maker's app flies has that app's file, too; its others show the same flight in QGroundControl.

    Raises:
        InputError: a mission has something that the file of a maker's app cannot say.
    """
    files: dict[str, str | bytes] = {}
    for vehicle in plan.vehicles:
        autopilot = flown_by(vehicle, autopilots)
        dialect: Autopilot = "px4" if autopilot == "px4" else "ardupilot"
        for index, sortie in enumerate(vehicle.sorties):
            name = sortie_name(vehicle, index)
            home = (sortie.home_lat_deg, sortie.home_lon_deg, 0.0)
            items = sortie_items(plan, sortie, dialect)
            files[f"{name}.plan"] = plan_text(items, home, dialect, plan.speed_m_s, plan.fences)
            files[f"{name}.waypoints"] = waypoints_text(items, home)
            if autopilot in MAKERS:
                return_height_m = plan.over_ground.return_height_m if plan.over_ground else None
                files[name + MAKERS[autopilot]] = maker_file(items, autopilot, return_height_m)
    return files


def report(
    plan: Plan, autopilots: Sequence[str], fov_min_deg: float, endurance_min: float | None = None
) -> dict[str, Any]:
    """The plan's figures as JSON: per vehicle and altogether.

    Args:
        autopilots: of its vehicles, in turn. fov_min_deg: field of view that it was made for.
        endurance_min: flight time of a full battery that it was made for, None if nobody said it.
    """
    return {
        "fov_min_deg": fov_min_deg,
        "method": plan.method,
        "covered_share": plan.covered_share,
        "complete": plan.covered_share is None or plan.covered_share >= 0.999,
        "makespan_s": round(plan.makespan_s, 1),
        "balance": round(plan.balance, 4),
        "altitude_m": plan.altitude_m,
        "speed_m_s": plan.speed_m_s,
        "spacing_m": round(plan.spacing_m, 3),
        "trigger_m": round(plan.trigger_m, 3),
        "footprint_m": [round(side, 3) for side in plan.footprint_m],
        "area_m2": None if plan.area_m2 is None else round(plan.area_m2, 1),
        "epsg": plan.epsg,
        "autopilot": autopilots[0] if len(set(autopilots)) == 1 else "mixed",
        "end": plan.end,
        "gimbal_pitch_deg": plan.gimbal_pitch_deg,
        "endurance_min": endurance_min,
        "separation": plan.separation,
        "separation_m": None if plan.apart is None else plan.apart.distance_m,
        "height_step_m": None if plan.apart is None else plan.apart.height_m,
        "over_ground": None if plan.over_ground is None else _over_ground(plan.over_ground),
        "vehicles": [_vehicle(vehicle, flown_by(vehicle, autopilots)) for vehicle in plan.vehicles],
        "gaps": [{"lat_deg": g.lat_deg, "lon_deg": g.lon_deg, "area_m2": g.area_m2} for g in plan.gaps],
        "warnings": list(plan.warnings),
    }


def _over_ground(over: OverGround) -> dict[str, Any]:
    return {
        "follows": over.follows,
        "terrain_items": over.by_vehicle,
        "nominal_m": over.nominal_m,
        "above_ground_m": [round(over.least_m, 2), round(over.most_m, 2)],
        "ground_pixels": [round(over.least_m / over.nominal_m, 4), round(over.most_m / over.nominal_m, 4)],
        "way_least_m": round(over.way_least_m, 2),
        "top_above_takeoff_m": round(over.top_m, 2),
        "side_overlap": [round(share, 4) for share in over.side_overlap],
        "forward_overlap": round(over.forward_overlap, 4),
        "return_height_m": over.return_height_m,
    }


def _vehicle(vehicle: VehiclePlan, autopilot: str) -> dict[str, Any]:
    suffixes = [*MISSION_SUFFIXES, *([MAKERS[autopilot]] if autopilot in MAKERS else [])]
    flights = [
        {
            "files": [sortie_name(vehicle, index) + suffix for suffix in suffixes],
            "start_s": round(sortie.start_s, 1),
            "time_s": round(sortie.time_s, 1),
            "length_m": round(sortie.length_m, 1),
            "turns": sortie.turns,
            "photos": sortie.photos,
            "legs": len(sortie.legs),
            "wait_s": max((point.wait_s for point in sortie.waypoints), default=0.0),
            "takeoff_height_m": sortie.takeoff_height_m,
        }
        for index, sortie in enumerate(vehicle.sorties)
    ]
    return {
        "id": vehicle.id,
        "autopilot": autopilot,
        "length_m": round(vehicle.length_m, 1),
        "turns": vehicle.turns,
        "time_s": round(vehicle.time_s, 1),
        "flight_s": round(vehicle.flight_s, 1),
        "sorties": len(vehicle.sorties),
        "photos": vehicle.photos,
        "flights": flights,
    }


def geojson(plan: Plan, area: Area | None) -> str:
    """One GeoJSON of everything: area, no-fly zones, legs, ways between them, starts and gaps.

    `circles_wider_m` of a no-fly zone: by how much circles in it are larger than in the file that they are from.
    """
    features: list[dict[str, Any]] = []
    if area is not None:
        for kind, geometry in (("area", area.ground), ("no-fly zone", area.no_fly)):
            said = {"circles_wider_m": area.circles_wider_m} if geometry is area.no_fly and area.circles_wider_m else {}
            features += [
                _feature("Polygon", rings, kind=kind, **said) for part in geometry.geoms for rings in _rings(area, part)
            ]
    for vehicle in plan.vehicles:
        for index, sortie in enumerate(vehicle.sorties):
            features += _sortie_features(vehicle, index, sortie)
    features += [_feature("Point", [g.lon_deg, g.lat_deg], kind="gap", area_m2=g.area_m2) for g in plan.gaps]
    return json.dumps({"type": "FeatureCollection", "features": features}) + "\n"


def _sortie_features(vehicle: VehiclePlan, index: int, sortie: Sortie) -> list[dict[str, Any]]:
    who = {"vehicle": vehicle.id, "sortie": index + 1}
    home = [round(sortie.home_lon_deg, 8), round(sortie.home_lat_deg, 8)]
    features = [_feature("Point", home, kind="start", **who, start_s=sortie.start_s)]
    way, number = [[*home, sortie.takeoff_height_m]], 0
    for point in sortie.waypoints:
        here = [round(point.lon_deg, 8), round(point.lat_deg, 8), point.height_m]
        way.append(here)
        if point.camera is False:
            number += 1
            features.append(_feature(*_line(way), kind="leg", **who, leg=number))
            way = [here]
        elif point.camera is True:
            features.append(_feature(*_line(way), kind="way", **who))
            way = [here]
    if len(way) > 1:
        features.append(_feature(*_line(way), kind="way", **who))
    return features


def _feature(shape: str, coordinates: Any, /, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": shape, "coordinates": coordinates}}


def _line(way: list[list[float]]) -> tuple[str, list[Any]]:
    """Kind and coordinates of a line of longitudes, latitudes and heights, cut where it crosses the 180th meridian."""
    parts = [[way[0]]]
    for here, there in pairwise(way):
        if abs(there[0] - here[0]) > 180.0:
            edge = math.copysign(180.0, here[0])
            share = (edge - here[0]) / wrap_deg(there[0] - here[0])
            rest = [round(a + share * (b - a), 8) for a, b in zip(here[1:], there[1:], strict=True)]
            parts[-1].append([edge, *rest])
            parts.append([[-edge, *rest]])
        parts[-1].append(there)
    return ("LineString", way) if len(parts) == 1 else ("MultiLineString", parts)


def _rings(area: Area, polygon: Any) -> list[list[list[list[float]]]]:
    """Rings of longitudes and latitudes of a polygon; of two where the 180th meridian cuts it (RFC 7946, 3.1.9)."""
    rings = shapely.get_rings(shapely.geometry.polygon.orient(polygon))
    places = [area.grid.to_geographic(shapely.get_coordinates(ring))[:, ::-1] for ring in rings]
    first = places[0][0, 0]
    across = [np.column_stack([first + wrap_deg(ring[:, 0] - first), ring[:, 1]]) for ring in places]
    whole, parts = shapely.Polygon(across[0], across[1:]), [(across, 0.0)]
    if whole.bounds[0] < -180.0 or whole.bounds[2] > 180.0:
        cut = [
            (shapely.intersection(whole, shapely.box(w - 180.0, -90.0, w + 180.0, 90.0)), w)
            for w in (-360.0, 0.0, 360.0)
        ]
        pieces = [(shapely.geometry.polygon.orient(p), w) for g, w in cut for p in shapely.get_parts(g) if p.area > 0.0]
        parts = [([shapely.get_coordinates(ring) for ring in shapely.get_rings(p)], w) for p, w in pieces]
    return [[[[round(float(x - w), 8), round(float(y), 8)] for x, y in ring] for ring in part] for part, w in parts]


def write_plan(
    folder: Path,
    plan: Plan,
    area: Area | None,
    request: PlanRequest,
    *,
    notes: Sequence[str] = (),
    picture: bool = True,
) -> dict[str, Any]:
    """Write a plan's folder: missions, `all.geojson`, `plan.json`, `plan.png`; returns the content of `plan.json`.

    Args:
        folder: missions of an earlier plan in it are replaced. plan, area: as `make_plan` gives them for the request.
        notes: warnings before the plan's own. picture: whether `plan.png` is drawn.

    Raises:
        InputError: the folder cannot be written, or holds other missions.
    """
    figures = report(plan, request.autopilots, request.fov_min_deg, request.endurance_min)
    figures["warnings"] = [*notes, *figures["warnings"]]
    if changed := changes(request.config):
        figures["config"] = changed
    files = mission_files(plan, request.autopilots)
    files["all.geojson"] = geojson(plan, area)
    files["plan.json"] = json.dumps(figures, indent=1) + "\n"
    if picture:
        files["plan.png"] = plan_picture(plan, area)
    write_folder(folder, files)
    return figures


def check_folder(folder: Path) -> None:
    """Refuse a folder whose missions are not from an earlier plan of ours: they would mix with the new ones.

    Raises:
        InputError: the folder is a file, or holds other mission files.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; name a folder with --out")
    foreign = sorted(p.name for p in _missions(folder) if p.name not in _own_missions(folder))
    if foreign:
        raise InputError(f"{folder} holds other missions ({', '.join(foreign[:3])}); name an empty folder with --out")


def write_folder(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write files into a folder, all or none: into a temporary one beside it first.

    Missions of an earlier plan in the folder are replaced; other files stay.

    Raises:
        InputError: the folder cannot be written.
    """
    check_folder(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}); name another folder with --out") from None
    try:
        for name, content in files.items():
            data = content.encode() if isinstance(content, str) else content
            with (temporary / name).open("wb") as file:  # a mission that a power cut has shortened would still be flown
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        if not folder.exists():
            temporary.chmod(0o755)
            os.replace(temporary, folder)
            return
        for old in _own_missions(folder) - files.keys():
            (folder / old).unlink(missing_ok=True)
        # The report names the missions that are ours, so it goes last (an earlier one still names the old ones).
        for name in sorted(files, key=lambda name: name == REPORT):
            os.replace(temporary / name, folder / name)
    except OSError as error:
        raise InputError(f"{folder} cannot be written ({error.strerror}); name another folder with --out") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _missions(folder: Path) -> list[Path]:
    return [p for p in folder.glob("*") if p.suffix in MISSION_SUFFIXES] if folder.is_dir() else []


def _own_missions(folder: Path) -> set[str]:
    try:
        document = json.loads((folder / REPORT).read_text(encoding="utf-8"))
        names = [name for vehicle in document["vehicles"] for flight in vehicle["flights"] for name in flight["files"]]
        return {Path(name).name for name in names}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def plan_picture(plan: Plan, area: Area | None) -> bytes:
    """The plan as a PNG; the area is None along given lines.

    Legs are thick, ways thin and dashed, starts dots, gaps red crosses; axes are metres from the lower left corner.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    grid = LocalGrid(plan.epsg)
    paths = {v.number: [sortie_path(s, grid) for s in v.sorties] for v in plan.vehicles}
    everything = np.concatenate([p for rows in paths.values() for p in rows])
    if area is not None:
        west, south, east, north = area.ground.bounds
        everything = np.concatenate([everything, [[west, south], [east, north]]])
    corner = everything.min(0)
    width, height = np.maximum(everything.max(0) - corner, 1.0)
    scale = _INCHES / max(width, height)
    figure = Figure(figsize=(max(5.0, width * scale + 1.2), max(4.0, height * scale + 1.4)), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    if area is not None:
        _fill(axes, area.ground, corner, "#e4e9e2", "#8a9a86")
        _fill(axes, area.no_fly, corner, "#f4b6ae", "#c0392b")
    thick = float(np.clip(220.0 / np.sqrt(len(plan.vehicles) * max(1, len(everything))), 0.8, 2.4))
    for vehicle in plan.vehicles:
        colour = _colour(vehicle.number - 1, len(plan.vehicles))
        for sortie, path in zip(vehicle.sorties, paths[vehicle.number], strict=True):
            _flight(axes, sortie, path - corner, colour, thick)
        if len(plan.vehicles) <= _LABELS:
            at = _middle(vehicle.sorties[0], paths[vehicle.number][0]) - corner
            box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": colour, "linewidth": 0.8}
            axes.annotate(vehicle.id, at, fontsize=8, weight="bold", ha="center", va="center", bbox=box)
    for gap in plan.gaps:
        axes.plot(*(grid.to_grid(gap.lat_deg, gap.lon_deg) - corner), "x", color="red", markersize=5)
    axes.set_xlabel("metres east")
    axes.set_ylabel("metres north")
    wider = (
        ""
        if area is None or not area.circles_wider_m
        else (f"\nred: no-fly zones, circles with {area.circles_wider_m:g} m around them")
    )
    axes.set_title(_title(plan) + wider, fontsize=9)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _title(plan: Plan) -> str:
    covered = "" if plan.covered_share is None else f", {100 * plan.covered_share:.2f} % covered"
    return (
        f"{plan.method}: {len(plan.vehicles)} vehicles at {plan.altitude_m:g} m{covered}\n"
        f"done after {plan.makespan_s / 60:.1f} min, longest path {plan.balance:.2f} x mean, "
        f"{sum(v.turns for v in plan.vehicles)} turns"
    )


def _middle(sortie: Sortie, path: Any) -> Any:
    """The middle of the longest leg."""
    ends = [k for k, point in enumerate(sortie.waypoints, start=1) if point.camera is False]
    longest = max(ends, key=lambda k: float(np.hypot(*(path[k] - path[k - 1]))))
    return 0.5 * (path[longest] + path[longest - 1])


def _flight(axes: Any, sortie: Sortie, path: Any, colour: Any, thick: float) -> None:
    axes.plot(*path.T, "--", color=colour, linewidth=0.4 * thick, alpha=0.8)
    for k, point in enumerate(sortie.waypoints, start=1):
        if point.camera is False:
            axes.plot(*path[k - 1 : k + 1].T, "-", color=colour, linewidth=thick, solid_capstyle="butt")
    axes.plot(*path[0], "o", color=colour, markersize=4, markeredgecolor="black", markeredgewidth=0.5)


def _fill(axes: Any, geometry: Any, corner: Any, face: str, edge: str) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for polygon in geometry.geoms:
        rings = [np.asarray(ring.coords)[:, :2] - corner for ring in (polygon.exterior, *polygon.interiors)]
        outline = Path.make_compound_path(*(Path(ring, closed=True) for ring in rings))
        axes.add_patch(PathPatch(outline, facecolor=face, edgecolor=edge, linewidth=0.6))


def _colour(index: int, count: int) -> Any:
    from matplotlib import colormaps

    if count <= 10:
        return colormaps["tab10"](index)
    # Neighbours in number are neighbours on the ground: golden steps keep their colours apart.
    return colormaps["hsv"]((index * 0.618034) % 1.0)


def read_planned_flight(folder: Path, grid: LocalGrid) -> PlannedFlight:
    """Legs and footprint of a folder that `orthoswarm plan` wrote (plan.json, all.geojson), in metres of a grid.

    Raises:
        InputError: the folder is not a plan's.
    """
    try:
        figures = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        features = json.loads((folder / "all.geojson").read_text(encoding="utf-8"))["features"]
        width, height = (float(side) for side in figures["footprint_m"])
        fov = math.radians(float(figures["fov_min_deg"]))
        # A leg over hills has several points; only its ends matter here.
        shapes = [f["geometry"] for f in features if f["properties"].get("kind") == "leg"]
        parts = [g["coordinates"] if g["type"] == "MultiLineString" else [g["coordinates"]] for g in shapes]
        lines = [[point for part in line for point in part] for line in parts]
        ends = np.array([[line[0][:2], line[-1][:2]] for line in lines], float).reshape(-1, 2, 2)
    except OSError as error:
        raise InputError(
            f"{folder} is not the folder of a plan ({error.strerror}); give the --out of `orthoswarm plan`"
        ) from None
    except (ValueError, KeyError, TypeError, IndexError):
        raise InputError(f"{folder} holds a broken plan.json or all.geojson; plan again") from None
    legs = grid.to_grid(ends[..., 1], ends[..., 0])
    return PlannedFlight(legs, width, height, fov)

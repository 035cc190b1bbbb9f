"""`orthoswarm plan`: from an area, or lines, to missions for a swarm."""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    from orthoswarm.model.plan import Plan
    from orthoswarm.planning.area.area import Area
    from orthoswarm.planning.area.shape_files import Ring, Shapes

_KINDS = {
    ".geojson": "GeoJSON",
    ".json": "GeoJSON",
    ".kml": "KML",
    ".kmz": "KMZ",
    ".plan": "a mission",
    ".waypoints": "a mission",
}
_LARGEST_BYTES = 50_000_000
_MOST_ITEMS = {"ardupilot": 650, "px4": 1900}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "AREA is a polygon (GeoJSON, KML, KMZ, or the survey of a QGroundControl .plan), or a line to follow\n"
        "(GeoJSON, KML, .plan, .waypoints). Holes, and exclusion fences of a .plan, are no-fly zones.\n\n"
        "example:\n  orthoswarm plan town.geojson --vehicles 8 --altitude 80 --fov-min 60 \\\n"
        "      --start 48.1371,11.5754 --out missions"
    )
    add = parser.add_argument
    add("area", type=Path, metavar="AREA", help="polygon to cover, or line to follow")
    add("--vehicles", type=int, required=True, metavar="N", help="how many vehicles")
    add("--altitude", type=float, required=True, metavar="M", help="height of the lines above takeoff, metres")
    add("--fov-min", type=float, required=True, metavar="DEG", help="smallest horizontal field of view in the swarm")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for missions, report and picture")
    add("--method", choices=["columns", "bcd", "tmstc"], default="bcd", help="how to lay lines (default bcd)")
    add("--autopilot", choices=["ardupilot", "px4"], default="ardupilot", help="whose dialect (default ardupilot)")
    add("--json", action="store_true", help="one JSON document on stdout")
    flight = parser.add_argument_group("flight")
    start_help = "takeoff point; give it again for more (default: at each vehicle's first line; --start=-33.9,18.4)"
    flight.add_argument("--start", action="append", default=[], metavar="LAT,LON", help=start_help)
    flight.add_argument(
        "--end", choices=["rtl", "land", "hover"], default="rtl", help="after the last line (default rtl)"
    )
    flight.add_argument("--speed", type=float, metavar="M/S", help="ground speed (default 10)")
    flight.add_argument(
        "--run-in",
        type=float,
        default=0.0,
        metavar="M",
        help="straight flight before a leg's first picture (default 0)",
    )
    flight.add_argument("--endurance", type=float, metavar="MIN", help="longest flight, minutes (default: no limit)")
    flight.add_argument("--swap", type=float, default=2.0, metavar="MIN", help="time to change a battery (default 2)")
    camera = parser.add_argument_group("pictures")
    camera.add_argument("--side-overlap", type=float, default=0.4, metavar="SHARE", help="between lines (default 0.4)")
    camera.add_argument("--forward-overlap", type=float, default=0.8, metavar="SHARE", help="along lines (default 0.8)")
    camera.add_argument("--aspect", default="4:3", metavar="W:H", help="picture's width to height (default 4:3)")
    safety = parser.add_argument_group("safety")
    safety.add_argument("--no-fly", type=Path, action="append", default=[], metavar="FILE", help="further no-fly zones")
    safety.add_argument(
        "--clearance", type=float, metavar="M", help="distance to no-fly zones (default 1, less for small pictures)"
    )
    safety.add_argument("--separation", type=float, default=10.0, metavar="M", help="between vehicles (default 10)")
    safety.add_argument("--height-step", type=float, default=5.0, metavar="M", help="between heights (default 5)")
    safety.add_argument("--ceiling", type=float, metavar="M", help="highest way out or home (default: 4 steps above)")
    parser.add_argument("--follow", action="store_true", help="follow the lines of a file that has polygons, too")


def run(args: argparse.Namespace) -> int:
    """Plan, write the folder, print the figures."""
    from gcs_plugin.plans.plan_files import check_folder, geojson, mission_files, report, write_folder

    check_folder(args.out)
    plan, area = make_plan(args)
    _say("files")
    from gcs_plugin.plans.plan_picture import draw

    figures = report(plan, args.autopilot)
    files: dict[str, str | bytes] = dict(mission_files(plan, args.autopilot))
    files["all.geojson"] = geojson(plan, area)
    files["plan.json"] = json.dumps(figures, indent=1) + "\n"
    files["plan.png"] = draw(plan, area)
    write_folder(args.out, files)
    _say("")
    if args.json:
        print(json.dumps(figures))
    else:
        _print(plan, args.out)
        if not args.start:
            print("no --start was given: each vehicle is meant to take off where its first line begins")
    return 0


def make_plan(args: argparse.Namespace) -> tuple["Plan", "Area | None"]:
    """The plan that the arguments ask for, and its area (None along lines without no-fly zones)."""
    from orthoswarm.planning.area.area import Area, make_area
    from orthoswarm.planning.lines.line_spacing import footprint
    from orthoswarm.planning.planner import plan_area, plan_lines
    from orthoswarm.planning.sorties.assignment import Options
    from orthoswarm.planning.sorties.deconfliction import Separation
    from orthoswarm.planning.sorties.flight_time import Motion

    foot = footprint(
        args.altitude, math.radians(args.fov_min), _aspect(args.aspect), args.side_overlap, args.forward_overlap
    )
    if not 0.0 <= args.swap < math.inf:
        raise InputError(f"the time to change a battery is {args.swap:g} min; give 0 or more")
    ceiling = args.altitude + 4 * args.height_step if args.ceiling is None else args.ceiling
    if not ceiling >= args.altitude:
        raise InputError(f"the ceiling of {ceiling:g} m is below the altitude of {args.altitude:g} m; raise it")
    layers = int(min(12.0, (ceiling - args.altitude) / args.height_step + 1e-9)) if args.height_step > 0 else 0
    options = Options(
        motion=Motion() if args.speed is None else Motion(speed_m_s=args.speed),
        end=args.end,
        starts=[_position(text) for text in args.start],
        endurance_s=math.inf if args.endurance is None else 60.0 * args.endurance,
        clearance_m=args.clearance,
        separation=Separation(args.separation, args.height_step, layers, swap_s=60.0 * args.swap),
        most_items=_MOST_ITEMS[args.autopilot],
        run_in_m=args.run_in,
    )
    _say("area")
    shapes, no_fly = read_shapes(args.area)
    for path in args.no_fly:
        further, fences = read_shapes(path)
        if not further.polygons and not fences:
            raise InputError(f"{path} holds no polygon to keep out of; give a polygon with --no-fly")
        no_fly += [*(p.shell for p in further.polygons), *fences]
    if shapes.polygons and not args.follow:
        area = make_area(shapes.polygons, no_fly)
        return plan_area(area, args.vehicles, args.altitude, foot, args.method, options, _say), area
    if not shapes.lines:
        raise InputError(f"{args.area} holds no {'line' if shapes.polygons else 'polygon and no line'}; draw one in it")
    zones: Area | None = _zones_only(shapes.lines, no_fly) if no_fly else None
    return plan_lines(shapes.lines, args.vehicles, args.altitude, foot, zones, options, _say), zones


def _zones_only(lines: "tuple[Ring, ...]", no_fly: "list[Ring]") -> "Area":
    """An area without ground that carries the no-fly zones."""
    import numpy as np
    import shapely

    from orthoswarm.model.geo import LocalGrid, area_epsg
    from orthoswarm.planning.area.area import Area, make_area
    from orthoswarm.planning.area.shape_files import Polygon

    points = np.concatenate(lines)
    grid = LocalGrid(area_epsg(points[:, 0], points[:, 1]))
    checked = [make_area([Polygon(zone)]) for zone in no_fly]  # says what is wrong with a zone
    zones = [shapely.transform(c.ground, lambda p, c=c: grid.to_grid(*c.grid.to_geographic(p).T)) for c in checked]
    return Area(grid, shapely.MultiPolygon(), shapely.MultiPolygon(list(shapely.get_parts(shapely.union_all(zones)))))


def read_shapes(path: Path) -> "tuple[Shapes, list[Ring]]":
    """Polygons and lines of a file, and rings of its exclusion fences; what the file is decides its content.

    Raises:
        InputError: it cannot be read, or its name promises something else.
    """
    from gcs_plugin.mission.mission_files import parse_mission
    from orthoswarm.planning.area.shape_files import Polygon, Shapes, parse_geojson, parse_kml, ring

    text, kind = _read(path)
    promised = _KINDS.get(path.suffix.lower(), kind)
    if promised != kind:
        raise InputError(f"{path} is {promised} by its name but holds {kind}; rename it or give the right file")
    if kind == "GeoJSON":
        return parse_geojson(text, str(path)), []
    if kind in ("KML", "KMZ"):
        return parse_kml(text, str(path)), []
    mission = parse_mission(text, str(path))
    polygons = tuple(Polygon(ring(survey, str(path))) for survey in mission.surveys)
    lines = tuple(ring(line, str(path), 2) for line in (mission.polylines or mission.lines()))
    return Shapes(polygons, lines), [ring(zone, str(path)) for zone in mission.no_fly]


def _read(path: Path) -> tuple[str, str]:
    """A file's text and what it seems to be."""
    import zipfile

    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{path} is larger than {_LARGEST_BYTES // 1_000_000} MB; give a simpler outline")
        data = path.read_bytes()
        kmz = data.startswith(b"PK\x03\x04")
        if kmz:
            with zipfile.ZipFile(path) as archive:
                inside = [i for i in archive.infolist() if i.filename.lower().endswith(".kml")]
                if not inside or inside[0].file_size > _LARGEST_BYTES:
                    raise InputError(f"{path} is a ZIP without a usable KML in it; export it again")
                data = archive.read(inside[0])
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the name") from None
    except (UnicodeDecodeError, zipfile.BadZipFile, NotImplementedError, RuntimeError):
        raise InputError(f"{path} is no text file with a polygon or a line; give GeoJSON, KML, KMZ or .plan") from None
    head = text.lstrip()
    if head.startswith("QGC WPL"):
        return text, "a mission"
    if head.startswith("<"):
        return text, "KMZ" if kmz else "KML"
    if head.startswith("{"):
        return text, "a mission" if _is_mission(text, path) else "GeoJSON"
    raise InputError(f"{path} holds neither GeoJSON, KML, a .plan nor a .waypoints mission; export the polygon again")


def _is_mission(text: str, path: Path) -> bool:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no valid JSON ({error}); export it again") from None
    return isinstance(document, dict) and document.get("fileType") == "Plan"


def _aspect(text: str) -> float:
    try:
        width, _, height = text.replace("/", ":").partition(":")
        return float(width) / float(height or 1.0)
    except (ValueError, ZeroDivisionError):
        raise InputError(f"the aspect ratio '{text}' is no W:H; give it as 4:3") from None


def _position(text: str) -> tuple[float, float]:
    try:
        lat, lon = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"the start '{text}' is no LAT,LON; give it in degrees as 48.1371,11.5754") from None
    return lat, lon


def _say(stage: str) -> None:
    """Show on a terminal what is being done."""
    if sys.stderr.isatty():
        print(f"\r\033[K{stage}", end="", file=sys.stderr, flush=True)


def _print(plan: "Plan", out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{plan.method} for {len(plan.vehicles)} vehicles in {out}")
    for name in ("vehicle", "path m", "turns", "photos", "sorties", "takeoff", "done"):
        table.add_column(name, justify="right")
    for vehicle in plan.vehicles:
        row: list[Any] = [vehicle.id, f"{vehicle.length_m:.0f}", vehicle.turns, vehicle.photos, len(vehicle.sorties)]
        row += [_clock(vehicle.sorties[0].start_s), _clock(vehicle.time_s)]
        table.add_row(*map(str, row))
    console = Console(highlight=False)
    console.print(table)
    if plan.covered_share is not None and plan.area_m2 is not None:
        gaps = f" (gaps: {len(plan.gaps)})" if plan.gaps else ""
        console.print(f"covered: {100 * plan.covered_share:.3f} % of {plan.area_m2 / 1e4:.2f} ha{gaps}")
    console.print(f"lines at most {plan.spacing_m:.1f} m apart, a picture every {plan.trigger_m:.1f} m")
    console.print(f"all done after {_clock(plan.makespan_s)} min; longest path {plan.balance:.2f} x mean")
    console.print(f"apart: {plan.separation}", soft_wrap=True)
    for warning in plan.warnings:
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)


def _clock(seconds: float) -> str:
    return f"{int(seconds // 60)}:{int(seconds % 60):02d}"

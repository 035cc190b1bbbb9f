"""`orthoswarm plan`: from an area, or lines, to missions for a swarm."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gcs_plugin.cli.configuration import add_config, use_config
from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    from gcs_plugin.plans.plan_request import PlanRequest
    from orthoswarm.model.plan import Plan


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "AREA is a polygon (GeoJSON, KML, KMZ, or the survey of a QGroundControl .plan), or a line to follow\n"
        "(GeoJSON, KML, .plan, .waypoints). Holes, and exclusion fences of a .plan, are no-fly zones.\n\n"
        "example:\n  orthoswarm plan town.geojson --vehicles 8 --altitude 80 --fov-min 60 \\\n"
        "      --start 48.1371,11.5754 --out missions"
    )
    add = parser.add_argument
    add("area", type=Path, nargs="?", metavar="AREA", help="polygon to cover, or line to follow")
    add("--gaps", type=Path, metavar="GAPS", help="instead of AREA: gaps.geojson of `orthoswarm coverage`, flown again")
    add(
        "--map",
        type=Path,
        metavar="OUT",
        help="take the field of view from this map's pictures, two sigma narrower",
    )
    add("--fly-not-arrived", action="store_true", help="fly gaps, too, whose pictures were taken but have not arrived")
    add("--vehicles", type=int, required=True, metavar="N", help="how many vehicles")
    add(
        "--altitude",
        type=float,
        required=True,
        metavar="M",
        help="height of the lines above takeoff, with --dem above the ground",
    )
    add("--fov-min", type=float, metavar="DEG", help="smallest horizontal field of view in the swarm")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for missions, report and picture")
    add("--method", choices=["columns", "bcd", "tmstc"], default="bcd", help="how to lay lines (default bcd)")
    autopilot_help = "for mission format and flight times; again for vehicles in turn (default ardupilot)"
    add("--autopilot", action="append", choices=["ardupilot", "px4"], help=autopilot_help)
    add_config(parser)
    add("--json", action="store_true", help="one JSON document on stdout")
    add("--dem", type=Path, metavar="FILE", help="height model; --altitude is then above the ground (needs --start)")
    relief_help = "with --dem: legs follow the ground, lie at one level, or whichever is done sooner (default auto)"
    add("--relief", choices=["auto", "follow", "level"], default="auto", help=relief_help)
    tolerance_help = "of the height above ground (default: a tenth of --altitude)"
    add("--height-tolerance", type=float, metavar="M", help=tolerance_help)
    terrain_help = "legs that follow the ground state heights above it (ArduPilot, which needs terrain data)"
    add("--terrain-items", action="store_true", help=terrain_help)
    flight = parser.add_argument_group("flight")
    start_help = "takeoff point; give it again for more (default: at each vehicle's first line; for example -33.9,18.4)"
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
    flight.add_argument("--wind-m-s", type=float, default=0.0, metavar="V", help="wind, m/s (default none)")
    wind_help = "where it comes from, degrees clockwise from north; --speed is then the speed through the air"
    flight.add_argument("--wind-from", type=float, default=0.0, metavar="DEG", help=wind_help)
    flight.add_argument("--swap", type=float, default=2.0, metavar="MIN", help="time to change a battery (default 2)")
    wait_help = "stay at the end of the last line for the coverage to be known, within --endurance, then come home"
    flight.add_argument("--wait", type=float, default=0.0, metavar="MIN", help=wait_help)
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
    from gcs_plugin.plans.plan_files import check_folder, write_plan
    from gcs_plugin.plans.plan_request import make_plan

    changed = use_config(args.config)
    check_folder(args.out)
    request = _request(args)
    plan, area = make_plan(request, _say)
    _say("files")
    figures = write_plan(args.out, plan, area, request, settings=changed)
    _say("")
    if args.json:
        print(json.dumps(figures))
    else:
        _print(plan, args.out)
        if not args.start:
            print("no --start was given: each vehicle is meant to take off where its first line begins")
    return 0


def _request(args: argparse.Namespace) -> "PlanRequest":
    """The plan request of the arguments."""
    from gcs_plugin.plans.plan_request import PlanRequest

    if (args.area is None) == (args.gaps is None):
        raise InputError("give either an AREA or --gaps GAPS.geojson")
    if (args.fov_min is None) == (args.map is None):
        raise InputError("give the smallest field of view with --fov-min, or with --map the map that it was solved in")
    return PlanRequest(
        area=args.area or args.gaps,
        gaps=args.gaps is not None,
        fly_not_arrived=args.fly_not_arrived,
        dem=args.dem,
        relief=args.relief,
        height_tolerance_m=args.height_tolerance,
        terrain_items=args.terrain_items,
        vehicles=args.vehicles,
        altitude_m=args.altitude,
        fov_min_deg=args.fov_min if args.map is None else _fov_of_map(args.map, args.dem is None),
        no_fly=args.no_fly,
        method=args.method,
        autopilots=args.autopilot or ["ardupilot"],
        end=args.end,
        starts=[_position(text) for text in args.start],
        speed_m_s=args.speed,
        run_in_m=args.run_in,
        endurance_min=args.endurance,
        wind_m_s=args.wind_m_s,
        wind_from_deg=args.wind_from,
        swap_min=args.swap,
        wait_min=args.wait,
        side_overlap=args.side_overlap,
        forward_overlap=args.forward_overlap,
        aspect=_aspect(args.aspect),
        clearance_m=args.clearance,
        separation_m=args.separation,
        height_step_m=args.height_step,
        ceiling_m=args.ceiling,
        follow=args.follow,
    )


def _fov_of_map(folder: Path, heights_over_level_ground: bool) -> float:
    """The smallest field of view to plan with of a map's vehicles, degrees; see `planning_fov_rad`."""
    from orthoswarm.coverage.map_folder import read_map
    from orthoswarm.coverage.planning_lens import planning_fovs_deg

    flown = read_map(folder)
    fovs = planning_fovs_deg(
        flown.views, ground_z_m=flown.ground_z_m, heights_over_level_ground=heights_over_level_ground
    )
    return min(fovs.values())


def _aspect(text: str) -> float:
    try:
        width, _, height = text.replace("/", ":").partition(":")
        return float(width) / float(height or 1.0)
    except (ValueError, ZeroDivisionError):
        raise InputError(f"the aspect ratio '{text}' is not of the form W:H; give it as 4:3") from None


def _position(text: str) -> tuple[float, float]:
    try:
        lat, lon = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(
            f"the start '{text}' is not of the form LAT,LON; give it in degrees as 48.1371,11.5754"
        ) from None
    return lat, lon


def _say(stage: str) -> None:
    """Show the present step on a terminal."""
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

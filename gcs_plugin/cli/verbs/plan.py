"""`orthoswarm plan`: from an area, or lines, to missions for a swarm."""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.cli.arguments import add_config, given
from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    from gcs_plugin.plans.plan_request import PlanRequest
    from orthoswarm.model.plan import Plan


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "AREA is a polygon (GeoJSON, KML, KMZ, or the survey of a QGroundControl .plan), or a line to follow\n"
        "(GeoJSON, KML, .plan, .waypoints, a mission of Pilot 2 or Litchi). Holes, and exclusion fences of a .plan,\n"
        "are no-fly zones.\n\n"
        "example:\n  orthoswarm plan town.geojson --vehicles 8 --altitude 80 --fov-min 60 \\\n"
        "      --start 48.1371,11.5754 --out missions"
    )
    add = parser.add_argument
    add("area", type=Path, nargs="?", metavar="AREA", help="polygon to cover, or line to follow")
    add("--gaps", type=Path, metavar="GAPS", help="instead of AREA: gaps.geojson of `orthoswarm coverage`, flown again")
    add("--map", type=Path, metavar="OUT", help="take the field of view from this map's pictures, two sigma narrower")
    add("--fly-not-arrived", action="store_true", help="fly gaps, too, whose pictures were taken but have not arrived")
    add("--vehicles", type=int, required=True, metavar="N", help="how many vehicles")
    altitude_help = "height of the lines above takeoff, with --dem above the ground (default: that of a survey in AREA)"
    add("--altitude", dest="altitude_m", type=float, metavar="M", help=altitude_help)
    add("--out", type=Path, required=True, metavar="DIR", help="folder for missions, report and picture")
    add("--method", choices=["columns", "bcd", "tmstc"], help="how to lay lines (default bcd)")
    heading_help = "of the lines: degrees from true north, along the wind, or along the area's longest side"
    add("--heading", metavar="DEG|wind|longest", help=heading_help)
    add("--cross", action="store_true", help="cover the area a second time by lines across the first")
    autopilot_help = (
        "for mission format and flight times: ardupilot, px4, or a drone that DJI's Pilot 2 or Litchi flies (m300,\n"
        "m300-p1, m350, m350-p1, m30, m30t, m3e, m3t, m4e, m4t, litchi); again for vehicles in turn (default ardupilot)"
    )
    add("--autopilot", dest="autopilots", action="append", metavar="NAME", help=autopilot_help)
    dji_help = "missions for DJI's Pilot 2, too, one .kmz a vehicle and flight: --autopilot m300 in short"
    add("--dji", dest="autopilots", action="append_const", const="m300", help=dji_help)
    add_config(parser)
    add("--json", action="store_true", help="one JSON document on stdout")
    add("--dem", type=Path, metavar="FILE", help="height model; --altitude is then above the ground (needs --start)")
    relief_help = "with --dem: legs follow the ground, lie at one level, or whichever is done sooner (default auto)"
    add("--relief", choices=["auto", "follow", "level"], help=relief_help)
    terrain_help = "legs that follow the ground state heights above it (ArduPilot, which needs terrain data)"
    add("--terrain-items", action="store_true", help=terrain_help)
    add("--follow", action="store_true", help="follow the lines of a file that has polygons, too")
    groups = {name: parser.add_argument_group(name) for name in ("flight", "pictures", "safety")}
    start_help = "takeoff point; give it again for more (default: at each vehicle's first line; for example -33.9,18.4)"
    groups["flight"].add_argument("--start", action="append", default=[], metavar="LAT,LON", help=start_help)
    groups["flight"].add_argument("--end", choices=["rtl", "land", "hover"], help="after the last line (default rtl)")
    groups["pictures"].add_argument("--aspect", metavar="W:H", help="picture's width to height (default 4:3)")
    gimbal_help = "pitch to which missions turn the gimbal, or none (default -90, straight down)"
    groups["pictures"].add_argument("--gimbal-pitch", metavar="DEG", help=gimbal_help)
    groups["safety"].add_argument("--no-fly", type=Path, action="append", metavar="FILE", help="further no-fly zones")
    for group, flag, name, unit, text in _NUMBERS:
        groups[group].add_argument(flag, dest=name, type=float, metavar=unit, help=text)


_NUMBERS: Final = (
    ("flight", "--speed", "speed_m_s", "M/S", "ground speed (default 10)"),
    ("flight", "--run-in", "run_in_m", "M", "straight flight before a leg's first picture (default 0)"),
    ("flight", "--endurance", "endurance_min", "MIN", "longest flight, minutes (default: no limit)"),
    ("flight", "--wind-m-s", "wind_m_s", "V", "wind, m/s (default none)"),
    (
        "flight", "--wind-from", "wind_from_deg", "DEG",
        "where it comes from, degrees clockwise from north; --speed is then the speed through the air",
    ),
    ("flight", "--swap", "swap_min", "MIN", "time to change a battery (default 2)"),
    (
        "flight", "--wait", "wait_min", "MIN",
        "stay at the end of the last line for the coverage to be known, within --endurance, then come home",
    ),
    ("pictures", "--fov-min", "fov_min_deg", "DEG", "smallest horizontal field of view in the swarm"),
    ("pictures", "--side-overlap", "side_overlap", "SHARE", "between lines (default 0.4)"),
    ("pictures", "--forward-overlap", "forward_overlap", "SHARE", "along lines (default 0.8)"),
    ("safety", "--height-tolerance", "height_tolerance_m", "M", "with --dem (default: a tenth of --altitude)"),
    ("safety", "--clearance", "clearance_m", "M", "distance to no-fly zones (default 1, less for small pictures)"),
    ("safety", "--separation", "separation_m", "M", "between vehicles (default 10)"),
    ("safety", "--height-step", "height_step_m", "M", "between heights (default 5)"),
    ("safety", "--ceiling", "ceiling_m", "M", "highest way out or home (default: 4 steps above)"),
)  # fmt: skip
"""Numbers of a plan: group in the help, flag, field of a PlanRequest, unit, help."""


def run(args: argparse.Namespace) -> int:
    """Plan, write the folder, print the figures."""
    from gcs_plugin.plans.plan_files import check_folder, write_plan
    from gcs_plugin.plans.plan_request import make_plan

    check_folder(args.out)
    request, notes = _request(args)
    plan, area = make_plan(request, _say)
    _say("files")
    figures = write_plan(args.out, plan, area, request, notes=notes)
    _say("")
    if args.json:
        print(json.dumps(figures))
    else:
        _print(plan, args.out, figures["warnings"])
        if not args.start:
            print("no --start was given: each vehicle is meant to take off where its first line begins")
    return 0


def _request(args: argparse.Namespace) -> tuple["PlanRequest", list[str]]:
    """The plan request of the arguments, and of a survey where these leave it open; and what of one was used."""
    from gcs_plugin.plans.plan_request import PlanRequest
    from orthoswarm.config import read_config

    if (args.area is None) == (args.gaps is None):
        raise InputError("give either an AREA or --gaps GAPS.geojson")
    if args.fov_min_deg is not None and args.map is not None:
        raise InputError("give the smallest field of view with --fov-min or the map that it was solved in, not both")
    values = given(args, PlanRequest) | {
        "area": args.area or args.gaps, "gaps": args.gaps is not None, "config": read_config(args.config),
        "starts": [_position(text) for text in args.start],
    }  # fmt: skip
    if args.map is not None:
        values["fov_min_deg"] = _fov_of_map(args.map, args.dem is None)
    if args.heading not in (None, "wind", "longest"):
        values["heading"] = _degrees(args.heading, "wind or longest")
    if args.gimbal_pitch is not None:
        values["gimbal_pitch_deg"] = None if args.gimbal_pitch == "none" else _degrees(args.gimbal_pitch, "none")
    if args.aspect is not None:
        values["aspect"] = _aspect(args.aspect)
    surveyed, notes = _survey(values) if values["area"].suffix.lower() == ".plan" and not args.gaps else ({}, [])
    values = surveyed | values
    if "altitude_m" not in values:
        why = "".join(f" ({note})" for note in notes)
        raise InputError(f"give the height of the lines with --altitude, metres{why}")
    if "fov_min_deg" not in values:
        raise InputError("give the smallest field of view with --fov-min, or with --map the map that it was solved in")
    return PlanRequest(**values), notes


def _survey(given_values: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """What a survey in the area's file says that was not given, and a sentence of that and of what is left."""
    from gcs_plugin.plans.area_files import read_shapes

    shapes, _, _, survey = read_shapes(given_values["area"])
    apart = {"heading", "cross"} if given_values.get("follow") or given_values.get("method") == "tmstc" else set()
    apart |= {"aspect"} if "fov_min_deg" in given_values else set()  # that of another camera
    if not shapes.areas or not (survey.values or survey.left):
        return {}, []
    used = [value for value in survey.values if value.field not in given_values and value.field not in apart]
    left = [value.words for value in survey.values if value not in used] + list(survey.left)
    said = [("taken", [value.words for value in used]), ("not taken", left)]
    told = "; ".join(f"{how}: {', '.join(words)}" for how, words in said if words)
    return {value.field: value.value for value in used}, [f"of the survey in {given_values['area'].name} {told}"]


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


def _degrees(text: str, words: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"'{text}' is no number of degrees; give one, or {words}") from None


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


def _print(plan: "Plan", out: Path, warnings: Sequence[str]) -> None:
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
    for warning in warnings:
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)


def _clock(seconds: float) -> str:
    return f"{int(seconds // 60)}:{int(seconds % 60):02d}"

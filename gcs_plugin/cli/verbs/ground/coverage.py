"""`orthoswarm coverage`: which ground of an area the pictures of a flight cover well, what was missed, and why."""

import argparse
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthoswarm.export.json_values import json_text
from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    from orthoswarm.coverage.coverage_grid import CoverageGrid
    from orthoswarm.coverage.gaps import Gaps
    from orthoswarm.coverage.map_folder import MapFolder
    from orthoswarm.coverage.missing_pictures import CameraEvent, MissingPicture
    from orthoswarm.model.geo import LocalGrid
    from orthoswarm.model.placement import Terrain
    from orthoswarm.planning.area.area import Area


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "OUT is the output folder of `orthoswarm mosaic`, or a workspace of `orthoswarm serve`. Several polygons are\n"
        "one area; holes in them are excluded. DIR gets cells.tif, gaps (.geojson, .gpkg, .kml), coverage.json and\n"
        "coverage.png; without --out nothing is written. gaps.geojson goes into `orthoswarm plan --gaps`.\n\n"
        "example:\n  orthoswarm coverage map --area town.geojson --plan missions --want-m 0.05 --out coverage"
    )
    add = parser.add_argument
    add("map", type=Path, metavar="OUT", help="folder with frames.jsonl and report.json")
    add("--area", type=Path, required=True, metavar="AREA", help="the area that was to be mapped (GeoJSON, KML, .plan)")
    add("--out", type=Path, metavar="DIR", help="folder for the results")
    add("--want-m", type=float, metavar="GSD", help="largest ground pixel that counts as well seen, metres")
    add("--want-sigma-m", type=float, metavar="M", help="largest position error of a picture, one sigma, metres")
    add("--plan", type=Path, metavar="DIR", help="folder of the plan that was flown: tells causes apart")
    add("--dem", type=Path, metavar="FILE", help="height model of the ground (default: level ground)")
    add("--cell", type=float, default=1.0, metavar="M", help="side of a cell, at most 1 m for areas that are flown")
    add("--pictures", action="store_true", help="decode the pictures to find blurred and damaged ones")
    log_help = "flight log (.tlog, .BIN, .ulg) whose camera events tell what was triggered; again for each vehicle"
    add("--log", action="append", default=[], metavar="[VEHICLE=]FILE", help=log_help)
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Compute, write, print."""
    from gcs_plugin.plans.area_files import read_shapes
    from gcs_plugin.plans.plan_files import read_planned_flight
    from orthoswarm.coverage.coverage_files import draw_cells, write_cells, write_gaps
    from orthoswarm.coverage.gaps import find_gaps
    from orthoswarm.coverage.map_folder import read_map
    from orthoswarm.coverage.missing_pictures import missing_by_events
    from orthoswarm.export.catalog.tiled_raster import product_file
    from orthoswarm.export.product_files import write_json
    from orthoswarm.model.geo import LocalGrid
    from orthoswarm.planning.area.area import make_area

    for name, value in (("--want-m", args.want_m), ("--want-sigma-m", args.want_sigma_m), ("--cell", args.cell)):
        if value is not None and not 0.0 < value < 1000.0:
            raise InputError(f"{name} is {value:g}; give metres larger than 0")
    flown = read_map(args.map)
    shapes, fences, *_ = read_shapes(args.area)
    if not shapes.areas:
        raise InputError(f"{args.area} holds no polygon; draw the area that was to be mapped")
    area = make_area(shapes.areas, fences, LocalGrid(flown.epsg))
    if args.pictures:
        flown = _judged(flown)
    cover = _cover(args, flown, area)
    plan = None if args.plan is None else read_planned_flight(args.plan, area.grid)
    missing, doubts = missing_by_events(flown.views, _events(args.log, flown, area.grid), flown.rejected)
    gaps = find_gaps(cover, missing, plan)
    warnings = [*flown.warnings, *doubts]
    if not (cover.best[cover.cells.wanted] != 255).any():
        warnings.append("no picture sees any of the area: check that the area and the flight belong together")
    figures = _figures(cover, gaps, missing, area.grid, warnings)
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        write_cells(args.out / "cells.tif", cover)
        write_gaps(args.out, gaps, area.grid)
        rasters = (product_file(args.map, name) for name in ("orthoimage.tif", "coarse.tif", "realtime.tif"))
        ortho = next((path for path in rasters if path is not None), None)
        draw_cells(args.out / "coverage.png", cover, gaps, ortho)
        write_json(args.out / "coverage.json", figures)
    if args.json:
        print(json_text(figures))
    else:
        _print(figures, args.out)
    return 0


def _events(logs: list[str], flown: "MapFolder", grid: "LocalGrid") -> "list[CameraEvent]":
    """The camera events of logs, each for its given vehicle, or for the only one of the map."""
    import numpy as np

    from orthoswarm.coverage.missing_pictures import CameraEvent
    from telemetry.formats.log.flight_logs import read_log

    vehicles = sorted({v.vehicle for v in flown.views})
    events = []
    for text in logs:
        named, _, path = text.rpartition("=") if not Path(text).exists() else ("", "", text)
        if named and named not in vehicles:
            raise InputError(f"the map has no vehicle {named}; give --log one of: {', '.join(vehicles)}")
        if not named and len(vehicles) > 1:
            raise InputError(f"say whose log {path} is, for example --log {vehicles[0]}={path}")
        for log in read_log(Path(path)):
            for number, event in enumerate(log.events):
                if event.time_s is None:
                    continue
                place, lat, lon = None, event.sample.lat_deg, event.sample.lon_deg
                if lat is not None and lon is not None:
                    place = np.array([*grid.to_grid(lat, lon), 0.0])
                counted = number if event.number is None else event.number
                events.append(CameraEvent(named or vehicles[0], counted, event.time_s, place))
    return events


def _judged(flown: "MapFolder") -> "MapFolder":
    """The map's pictures with their quality."""
    from gcs_plugin.cli.arguments import ProgressBars
    from orthoswarm.coverage.map_folder import with_flaws

    if flown.root is None or not flown.root.is_dir():
        raise InputError(f"the pictures are not at {flown.root}; leave out --pictures or bring them back")
    with ProgressBars() as bars:
        views, unread = with_flaws(flown.views, flown.root, lambda done, total: bars("pictures", done, total))
    more = [f"{unread} pictures could not be judged by their pixels"] if unread else []
    return replace(flown, views=views, warnings=[*flown.warnings, *more])


def _cover(args: argparse.Namespace, flown: "MapFolder", area: "Area") -> "CoverageGrid":
    from orthoswarm.coverage.coverage_grid import Cells, CoverageGrid, Demands
    from orthoswarm.model.placement import Terrain

    cells = Cells.of_area(area.grid.epsg, area.ground, area.no_fly, args.cell)
    terrain = Terrain.flat(flown.ground_z_m) if args.dem is None else _terrain(args.dem, cells.grid.bounds, flown)
    cover = CoverageGrid(cells, terrain, Demands(args.want_m, args.want_sigma_m))
    cover.put(flown.views)
    return cover


def _terrain(dem: Path, bounds: Any, flown: "MapFolder") -> "Terrain":
    """A DEM's heights, shifted so that the ground below the cameras has the level found by the map."""
    import numpy as np

    from orthoswarm.raster.height_model import HeightModel

    cameras = np.array([v.position for v in flown.views]) - [0.0, 0.0, flown.ground_z_m]
    around = bounds.grown(200.0)
    terrain = HeightModel.open(dem, flown.epsg, around, cameras).window(around).terrain
    return replace(terrain, z=terrain.z + np.float32(flown.ground_z_m))


def _figures(
    cover: "CoverageGrid", gaps: "Gaps", missing: "list[MissingPicture]", grid: Any, warnings: list[str]
) -> dict[str, Any]:
    from orthoswarm.coverage.coverage_files import gap_row

    shares = cover.shares()
    cells = cover.cells
    return {
        "seen_share": shares.seen,
        "poor_share": shares.poor,
        "missed_share": shares.missed,
        "area_m2": cells.area_m2,
        "excluded_m2": float(cells.excluded.sum()) * cells.grid.gsd_m**2,
        "cell_m": cells.grid.gsd_m,
        "epsg": cells.grid.epsg,
        "demands": asdict(cover.demands),
        "pictures": len(cover.views),
        "gaps": [gap_row(gap, grid) for gap in gaps.gaps],
        "small_gaps": {"count": gaps.small, "area_m2": gaps.small_m2},
        "missing_pictures": [
            {"vehicle": m.view.vehicle, "image": m.view.image, "after": m.after, "cause": str(m.cause),
             "confidence": round(m.confidence, 2)}
            for m in missing
        ],
        "warnings": warnings,
    }  # fmt: skip


def _print(figures: dict[str, Any], out: Path | None) -> None:
    parts = ", ".join(f"{name} {100 * figures[f'{name}_share']:.2f} %" for name in ("seen", "poor", "missed"))
    print(f"{figures['area_m2'] / 1e4:.2f} ha in cells of {figures['cell_m']:g} m: {parts}")
    for gap in figures["gaps"][:20]:
        detail = f" ({gap['detail']})" if gap["detail"] else ""
        who = f", {gap['vehicle']}" if gap["vehicle"] else ""
        place = f"{gap['lat_deg']:.6f}, {gap['lon_deg']:.6f}"
        sure = f"{100 * gap['confidence']:.0f} % sure"
        print(f"gap of {gap['area_m2']:.0f} m2 at {place}: {gap['cause']}{detail}{who}, {sure}")
    more = len(figures["gaps"]) - 20
    if more > 0:
        print(f"and {more} further gaps (--out writes all)" if out is None else f"and {more} further gaps in {out}")
    if figures["small_gaps"]["count"]:
        print(f"and {figures['small_gaps']['count']} below 4 m2, {figures['small_gaps']['area_m2']:.0f} m2 together")
    if figures["missing_pictures"]:
        print(f"{len(figures['missing_pictures'])} pictures are missing in the legs flown (--json names them)")
    for warning in figures["warnings"]:
        print(f"warning: {warning}", file=sys.stderr)
    if out is not None:
        print(f"written to {out}")

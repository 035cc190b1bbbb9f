"""`orthoswarm change`: where the ground is no longer what the pre-disaster map shows, and what has become of it."""

import argparse
import sys
from pathlib import Path
from typing import Any

from orthoswarm.export.json_values import json_text
from orthoswarm.model.errors import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "OUT is the output folder of `orthoswarm mosaic`, or a workspace of `orthoswarm serve`. DIR gets change.tif\n"
        "(the probability that the ground changed, 0 to 255; masked where it cannot be said), change.gpkg (changed\n"
        "ground as polygons with area, probability, kind and photos) and change.json. With --out OUT, the exports of\n"
        "the map have them, too.\n\n"
        "example:\n  orthoswarm change map --out map"
    )
    add = parser.add_argument
    add("map", type=Path, metavar="OUT", help="folder with orthoimage.tif, frames.jsonl and report.json")
    add("--basemap", type=Path, metavar="MAP", help="the pre-disaster map (default: that of OUT)")
    add("--want-m", type=float, default=2.0, metavar="M", help="side of a cell (default 2)")
    threshold_help = "list ground from this probability on: lower misses less, higher errs less (default 0.5)"
    add("--threshold", type=float, default=0.5, metavar="P", help=threshold_help)
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Compare, write, print."""
    from gcs_plugin.cli.arguments import ProgressBars, require_no_file
    from orthoswarm.change.of_folder import change_of
    from orthoswarm.compute.workers import prepare_process
    from orthoswarm.report.page import put_section

    if not 0.25 <= args.want_m < 1000.0:
        raise InputError(f"--want-m is {args.want_m:g}; give metres, 0.25 or more")
    if not 0.0 < args.threshold < 1.0:
        raise InputError(f"--threshold is {args.threshold:g}; give a probability between 0 and 1")
    require_no_file("--out", args.out)
    prepare_process()
    with ProgressBars() as bars:
        figures = change_of(
            args.map, args.out, basemap=args.basemap, want_m=args.want_m, threshold=args.threshold, progress=bars
        )
    put_section(args.map, args.out)
    if args.json:
        print(json_text(figures))
    else:
        _print(figures, args.out)
    return 0


def _print(figures: dict[str, Any], out: Path) -> None:
    shares = f"{figures['changed_share']:.1%} changed, {figures['not_visible_share']:.1%} not visible"
    print(f"{figures['area_m2'] / 1e4:.2f} ha in cells of {figures['cell_m']:g} m: {shares}")
    for row in figures["largest"]:
        place = f"{row['lat_deg']:.6f}, {row['lon_deg']:.6f}"
        print(f"{row['area_m2']:.0f} m2 at {place}: {row['kind']}, {100 * row['probability']:.0f} %")
    more = figures["count"] - len(figures["largest"])
    if more > 0:
        print(f"and {more} smaller ones in {out / 'change.gpkg'}")
    for warning in figures["warnings"]:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"written to {out}")

"""`orthoswarm basemap`: a map of an area out of a tile server, in one file that needs no internet."""

import argparse
from pathlib import Path

from orthoswarm.export.json_values import json_text
from orthoswarm.model.errors import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "URL is the address of a server's tiles, https://.../{z}/{x}/{y}.png, or of its TileJSON. Whether tiles may\n"
        "be kept is for its licence to say. The file is a basemap for `mosaic` and `serve`; what was fetched is kept\n"
        "when it stops, and the same command goes on from there.\n\n"
        "example:\n  orthoswarm basemap https://tiles.example.org/{z}/{x}/{y}.jpg --area town.geojson --out map.mbtiles"
    )
    add = parser.add_argument
    add("url", metavar="URL", help="address of tiles with {z}, {x}, {y}, or of a TileJSON")
    add("--area", type=Path, required=True, metavar="AREA", help="the area to be mapped (GeoJSON, KML, .plan)")
    add("--out", type=Path, required=True, metavar="FILE.mbtiles", help="the map")
    add("--margin", type=float, default=300.0, metavar="M", help="how far beyond the area (default 300 m)")
    add("--gsd", type=float, default=0.3, metavar="M", help="largest ground pixel (default 0.3 m)")
    add("--attribution", default="", metavar="TEXT", help="whose map it is and under which licence, kept in the file")
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Fetch, and say what came."""
    from dataclasses import asdict, replace

    from gcs_plugin.cli.arguments import ProgressBars, require_no_file
    from gcs_plugin.plans.area_files import read_shapes
    from gcs_plugin.plans.basemap_download import download, grown, tile_server

    if args.out.suffix != ".mbtiles":
        raise InputError(f"--out {args.out} is an MBTiles file; let its name end in .mbtiles")
    for name, value, most in (("--gsd", args.gsd, 100.0), ("--margin", args.margin, 50_000.0)):
        if not 0.0 <= value <= most or (name == "--gsd" and value < 0.01):
            raise InputError(f"{name} {value:g} is out of range; give metres up to {most:g}")
    require_no_file("--out", args.out.parent)
    shapes = read_shapes(args.area).shapes
    if not shapes.areas:
        raise InputError(f"{args.area} holds no polygon; draw the area that is to be mapped")
    server = tile_server(args.url)
    server = replace(server, attribution=args.attribution or server.attribution)
    with ProgressBars() as progress:
        corners = grown([polygon.shell for polygon in shapes.areas], args.margin)
        found = download(server, corners, args.out, pixel_m=args.gsd, progress=progress)
    if args.json:
        print(json_text(asdict(found) | {"attribution": server.attribution}, 1))
        return 0
    size_mb = args.out.stat().st_size / 1e6
    print(f"{args.out}: {found.tiles} tiles to zoom {found.zoom}, {found.pixel_m:.2f} m a pixel, {size_mb:.0f} MB")
    if found.pixel_m > 1.01 * args.gsd:
        print(f"note: the server has no tiles of {args.gsd:g} m a pixel here")
    if found.lacking:
        print(f"note: it lacks {found.lacking} tiles of that zoom: the map has holes, or ends there")
    if not server.attribution:
        print("note: the server names no licence: check that its tiles may be kept, and name it with --attribution")
    return 0

"""`orthoswarm export`: a finished map in the formats of other programs."""

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

FORMATS = (
    "mbtiles",
    "kmz",
    "gpkg",
    "odm",
    "colmap",
    "opensfm",
    "cog",
    "stac",
    "pmtiles",
    "pdf",
    "places",
    "tak",
    "pack",
)

_WITHOUT_REPORT = frozenset({"mbtiles", "kmz", "gpkg", "cog", "pmtiles"})


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "mbtiles  web map tiles for tablets and offline maps\n"
        "kmz      Google Earth, ATAK and other globes\n"
        "gpkg     footprints of the pictures as polygons\n"
        "odm      pictures and refined positions for OpenDroneMap\n"
        "colmap   refined cameras as a COLMAP model, to densify from\n"
        "opensfm  refined cameras as an OpenSfM reconstruction, to densify from\n"
        "cog      the orthoimage in another coordinate system or as a small JPEG\n"
        "stac     a STAC item beside the orthoimage, for catalogues\n"
        "pmtiles  web map tiles in one file for web servers\n"
        "pdf      a sheet of A3 with grid, scale and accuracy (GeoPDF)\n"
        "places   finds and vehicles as GeoJSON, KML, GPX and CSV\n"
        "tak      finds and vehicles as a data package for ATAK and WinTAK\n"
        "pack     all of it in one ZIP, with a page that opens without a server\n\n"
        "example:\n  orthoswarm export map --to mbtiles kmz"
    )
    add = parser.add_argument
    add("map", type=Path, metavar="OUT", help="output folder of `orthoswarm mosaic`")
    add("--to", nargs="+", choices=FORMATS, required=True, metavar="FORMAT", help=", ".join(FORMATS))
    add("--layer", choices=("realtime", "coarse", "orthoimage"), help="which picture (default: the best there is)")
    add("--dest", type=Path, metavar="DIR", help="where to write (default: OUT/export)")
    add("--tile-format", choices=("png", "webp", "jpg"), default="png", help="of MBTiles (default png)")
    add("--quality", type=int, default=85, metavar="Q", help="of JPEG and WebP, 1 to 100 (default 85)")
    add("--epsg", type=int, metavar="CODE", help="coordinate system of the COG (default: as it is)")
    add("--jpeg", action="store_true", help="COG as a JPEG, a tenth of the size, with small losses")
    add("--images", type=Path, metavar="DIR", help="folder of the pictures, if they were moved since")
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Write the files."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    import json

    from gcs_plugin.cli.progress import ProgressBars
    from gcs_plugin.cli.written_files import require_no_file
    from orthoswarm.model.errors import InputError

    if not 1 <= args.quality <= 100:
        raise InputError(f"--quality {args.quality} is out of range; give 1 to 100")
    if not args.map.is_dir():
        raise InputError(f"{args.map} is not a folder; name the output folder of `orthoswarm mosaic`")
    dest = args.dest or args.map / "export"
    require_no_file("--dest", dest)
    named_like_products = sorted({"cog", "gpkg", "places"}.intersection(args.to))
    if named_like_products and (dest / "frames.jsonl").exists():
        raise InputError(
            f"--dest {dest} holds a map, of which {' and '.join(named_like_products)} would replace files; choose "
            "another folder"
        )
    if not _WITHOUT_REPORT.issuperset(args.to):
        _require_report(args.map / "report.json")
    made: dict[str, str] = {}
    notes: list[str] = []
    with ProgressBars() as bars:
        for kind in args.to:
            made[kind] = str(_WRITERS[kind](args, dest, partial(bars, f"writing {kind}"), notes))
    if args.json:
        print(json.dumps({"files": made, "notes": notes}, indent=1, ensure_ascii=False))
    else:
        print(*made.values(), sep="\n")
        for note in notes:
            print(f"note: {note}")
    return 0


def _require_report(path: Path) -> None:
    """Refuse a damaged report before the work; formats that need none accept that there is none.

    Raises:
        InputError: it is there and cannot be read.
    """
    import json

    from orthoswarm.model.errors import InputError

    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); make the map again") from None
    if not isinstance(document, dict):
        raise InputError(f"{path} is not the report of a map; make the map again")


Tell = Callable[[int, int], None]


def _layer(args: argparse.Namespace) -> Path:
    """The picture to export."""
    from orthoswarm.export.catalog.tiled_raster import product_file
    from orthoswarm.model.errors import InputError

    names = [args.layer] if args.layer else ["orthoimage", "coarse", "realtime"]
    for name in names:
        path = product_file(args.map, f"{name}.tif")
        if path is not None:
            return path
    raise InputError(f"{args.map} holds no {' or '.join(names)}.tif; make the map with `orthoswarm mosaic` first")


def _mbtiles(args: argparse.Namespace, dest: Path, tell: Tell, notes: list[str]) -> Path:
    from orthoswarm.export.tiles.mbtiles import write_mbtiles

    layer = _layer(args)
    path = dest / f"{layer.stem}.mbtiles"
    write_mbtiles(layer, path, name=layer.stem, tile_format=args.tile_format, quality=args.quality, progress=tell)
    return path


def _kmz(args: argparse.Namespace, dest: Path, tell: Tell, notes: list[str]) -> Path:
    from orthoswarm.export.tiles.kmz import write_kmz

    layer = _layer(args)
    path = dest / f"{layer.stem}.kmz"
    write_kmz(layer, path, name=layer.stem, progress=tell)
    return path


def _gpkg(args: argparse.Namespace, dest: Path, tell: Tell, notes: list[str]) -> Path:
    import shutil

    from orthoswarm.export.atomic_file import atomic_write
    from orthoswarm.model.errors import InputError

    source = args.map / "footprints.gpkg"
    if not source.exists():
        raise InputError(f"{args.map} holds no footprints.gpkg; make the map with `orthoswarm mosaic` first")
    path = dest / "footprints.gpkg"
    with atomic_write(path) as part:
        shutil.copyfile(source, part)
    tell(1, 1)
    return path


def _cameras(kind: str, args: argparse.Namespace, dest: Path, tell: Tell, notes: list[str]) -> Path:
    """A folder of another program with the refined cameras."""
    import json

    from orthoswarm.export.colmap_folder import write_colmap
    from orthoswarm.export.odm_folder import write_odm
    from orthoswarm.export.opensfm_folder import write_opensfm
    from orthoswarm.export.product_files import read_frames
    from orthoswarm.model.errors import InputError
    from orthoswarm.stores.addresses import path_of

    lines = args.map / "frames.jsonl"
    if not lines.exists():
        raise InputError(f"{args.map} holds no frames.jsonl; make the map with `orthoswarm mosaic` first")
    try:
        report = json.loads((args.map / "report.json").read_text(encoding="utf-8"))
        rows = list(read_frames(lines))
    except (OSError, ValueError) as error:
        raise InputError(f"report.json or frames.jsonl of {args.map} cannot be read ({error}); make it again") from None
    root = args.images or (path_of(report["root"]) if report.get("root") else None)

    def find(row: Mapping[str, Any]) -> Path | None:
        path = root / row["image"] if root else None
        return path if path is not None and path.is_file() else None

    write = {"odm": write_odm, "colmap": write_colmap, "opensfm": write_opensfm}[kind]
    gone = write(rows, find, dest / kind, progress=tell)
    if gone:
        notes.append(f"{len(gone)} pictures are not where they were and were left out, the first is {gone[0]}")
    return dest / kind


def _cog(args: argparse.Namespace, dest: Path, tell: Tell, notes: list[str]) -> Path:
    from orthoswarm.export.cog_conversion import convert_cog

    layer = _layer(args)
    path = dest / f"{layer.stem}.tif"
    convert_cog(layer, path, epsg=args.epsg, jpeg_quality=args.quality if args.jpeg else None)
    tell(1, 1)
    return path


def _form(name: str, args: argparse.Namespace, dest: Path, tell: Tell, notes: list[str]) -> Path:
    from orthoswarm.export.sheets.forms import write_form
    from orthoswarm.export.tactical.places import read_places

    places = read_places(args.map)
    if not places and name in ("places", "tak"):
        notes.append(
            "there are no finds and no vehicles; `orthoswarm serve` keeps them as places.geojson in its folder"
        )
    path = write_form(name, _layer(args), dest, places, tell)
    tell(1, 1)
    return path


_WRITERS: dict[str, Callable[[argparse.Namespace, Path, Tell, list[str]], Path]] = {
    "mbtiles": _mbtiles,
    "kmz": _kmz,
    "gpkg": _gpkg,
    "odm": partial(_cameras, "odm"),
    "colmap": partial(_cameras, "colmap"),
    "opensfm": partial(_cameras, "opensfm"),
    "cog": _cog,
    **{name: partial(_form, name) for name in ("stac", "pmtiles", "pdf", "places", "tak", "pack")},
}

"""`orthoswarm export`: a finished map in the formats of other programs."""

import argparse
import json
from functools import partial
from pathlib import Path

from orthoswarm.export.forms import FORMS, MapExport
from orthoswarm.model.errors import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = "".join(f"{name:<8} {form.use}\n" for name, form in FORMS.items()) + (
        "\nexample:\n  orthoswarm export map --to mbtiles kmz"
    )
    add = parser.add_argument
    add("map", type=Path, metavar="OUT", help="output folder of `orthoswarm mosaic`")
    add("--to", nargs="+", choices=tuple(FORMS), required=True, metavar="FORMAT", help=", ".join(FORMS))
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

    from gcs_plugin.cli.arguments import ProgressBars, require_no_file

    if not 1 <= args.quality <= 100:
        raise InputError(f"--quality {args.quality} is out of range; give 1 to 100")
    if not args.map.is_dir():
        raise InputError(f"{args.map} is not a folder; name the output folder of `orthoswarm mosaic`")
    dest = args.dest or args.map / "export"
    require_no_file("--dest", dest)
    named_like_products = sorted({name for name in args.to if FORMS[name].replaces})
    if named_like_products and (dest / "frames.jsonl").exists():
        raise InputError(
            f"--dest {dest} holds a map, of which {' and '.join(named_like_products)} would replace files; choose "
            "another folder"
        )
    if any(FORMS[name].report for name in args.to):
        _require_report(args.map / "report.json")
    made: dict[str, str] = {}
    notes: list[str] = []
    with ProgressBars() as bars:
        for kind in args.to:
            tell = partial(bars, f"writing {kind}")
            what = MapExport(
                folder=args.map, dest=dest, layer=args.layer or "", images=args.images, tile_format=args.tile_format,
                quality=args.quality, epsg=args.epsg, jpeg=args.jpeg, tell=tell, notes=notes,
            )  # fmt: skip
            made[kind] = str(FORMS[kind].write(what))
            tell(1, 1)
    if args.json:
        print(json.dumps({"files": made, "notes": notes}, indent=1, ensure_ascii=False))
    else:
        print(*made.values(), sep="\n")
        for note in notes:
            print(f"note: {note}")
    return 0


def _require_report(path: Path) -> None:
    """Refuse a damaged report before the work; formats that need none accept that there is none."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); make the map again") from None
    if not isinstance(document, dict):
        raise InputError(f"{path} is not the report of a map; make the map again")

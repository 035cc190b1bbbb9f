"""`orthoswarm mosaic`: a georeferenced orthoimage from drone photos."""

import argparse
import gc
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from gcs_plugin.cli.arguments import add_config, given
from orthoswarm.export.json_values import json_text
from orthoswarm.stores.addresses import address_of, path_of

if TYPE_CHECKING:
    from orthoswarm.batch.run_state import MapOptions
    from orthoswarm.compute.workers import Workers
    from orthoswarm.config import Config
    from orthoswarm.model.frame import Ingest
    from orthoswarm.model.task_runner import Progress

_NEAR_M = 300.0  # an area that people can name, and that is searched in a minute
_PLACING = ("basemap", "near", "control", "checkpoints", "dem", "surface")  # what needs coordinates, or gives them
_REASONS = 5  # printed; all are in the report


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "A folder of photos is read with its sub-folders; each sub-folder with photos is one vehicle.\n"
        "INPUT, MAP, the DEM and DIR may be addresses: s3://, gs:// or, to read, https:// (docs/cluster.md).\n\n"
        "example:\n  orthoswarm mosaic photos --basemap before.tif --out map\n"
        "  orthoswarm mosaic s3://flood/photos --basemap s3://flood/before.tif --out s3://flood/map"
    )
    add = parser.add_argument
    add("inputs", nargs="+", type=path_of, metavar="INPUT", help="folders of photos, photos, videos")
    add("--basemap", type=path_of, metavar="MAP", help="pre-disaster map: GeoTIFF, COG, MBTiles or folder z/x/y.png")
    add(
        "--near", type=_near, metavar="LAT,LON[,M]",
        help=f"look for photos without a position on the basemap, within M metres of there (default {_NEAR_M:g})",
    )  # fmt: skip
    add("--out", type=path_of, required=True, metavar="DIR", help="output folder; an interrupted run goes on there")
    add(
        "--unreferenced", action="store_true",
        help="of photos without any position make a picture without place, scale and north: unreferenced.tif",
    )  # fmt: skip
    refiners = ["swarm", "paper"] if find_spec("orthoswarm.paper") else ["swarm"]
    add("--refine", choices=refiners, default=refiners[0], help=f"how pictures are refined (default {refiners[0]})")
    add(
        "--quick", action="store_true",
        help="draw the refined map at a quarter of the detail; the same command without it goes on from there",
    )  # fmt: skip
    add("--until", choices=("realtime", "coarse", "fine"), default="fine", help="last stage to run (default fine)")
    add(
        "--fov-min",
        dest="fov_min_deg",
        type=float,
        metavar="DEG",
        help="field of view assumed in real time (default: photo tags, else 70)",
    )
    add("--gsd", dest="gsd_m", type=float, metavar="M", help="ground pixel (default: the pictures' own)")
    add("--sei-layout", type=Path, action="append", default=[], metavar="FILE", help="layout of a maker's private SEI")
    add_config(parser)
    add(
        "--dem",
        type=path_of,
        metavar="FILE",
        help="raster of ground heights, instead of terrain found from the pictures",
    )
    add(
        "--surface", type=path_of, metavar="FILE.tif",
        help="also write a surface model there: height of ground, roofs and crowns, with its sigma",
    )  # fmt: skip
    add(
        "--control", type=path_of, metavar="FILE",
        help="surveyed points that move the map onto the ground: ODM's gcp_list.txt, or a CSV (docs/usage.md)",
    )  # fmt: skip
    add(
        "--checkpoints", type=path_of, metavar="FILE", help="surveyed points at which the map is measured, same formats"
    )
    add(
        "--pixel-scale", type=float, default=1.0, metavar="S",
        help="for points marked in larger copies of the photos: pixels of these to one of those, for example 0.2",
    )  # fmt: skip
    add(
        "--every-m", type=float, metavar="M", help="of a video one picture every M metres (default: 4 %% of the height)"
    )
    add("--every-s", type=float, metavar="S", help="of a video one picture every S seconds")
    add(
        "--camera", choices=("wide", "zoom", "thermal"), default="",
        help="which sensor's photos are mapped, of cameras with several (default: the widest in colour)",
    )  # fmt: skip
    add(
        "--band", default="", metavar="NAME",
        help="which spectral band of a multispectral camera is mapped: green, nir, 'red edge' ... (default: colour)",
    )  # fmt: skip
    add("--split", choices=("legs",), help="treat each straight leg of a flight as a vehicle of its own")
    add("--no-gains", dest="gains", action="store_false", help="leave brightness as it is in each picture")
    add(
        "--tone", choices=("photos", "map"), default="photos",
        help="brightness and hue of large areas: as the photos have it (default), or as the basemap has",
    )  # fmt: skip
    add("--edge", choices=("all", "trim"), default="all", help="the orthoimage's edge: all, or what several photos see")
    add("--blend", choices=("none", "seam"), default="seam", help="blend pictures over a few pixels at seams, or not")
    add(
        "--temperature", type=float, nargs="?", const=0.0, metavar="KELVIN",
        help="also write temperature.tif, of thermal photos in 32-bit TIFF, or in 16 bits with so many kelvin a count",
    )  # fmt: skip
    add("--covariance", action="store_true", help="add covariances of position and rotation to frames.jsonl")
    add(
        "--tiles", choices=("auto", "yes", "no"), default="auto",
        help="write rasters in tiles with a STAC collection (default: those of more than 4 billion pixels)",
    )  # fmt: skip
    add("--workers", type=int, metavar="N", help="processes at once (default: one for each core, one for few photos)")
    add(
        "--device", choices=("auto", "cpu", "cuda"),
        help="where networks of learned matchers run (default auto: a CUDA card where there is one)",
    )  # fmt: skip
    add(
        "--cluster", metavar="URL", help="work on a Dask cluster, for example tcp://192.168.1.10:8786 (docs/cluster.md)"
    )
    add("--json", action="store_true", help="print the report as one JSON document on stdout")


def _near(text: str) -> tuple[float, float, float]:
    """Latitude, longitude and radius of --near."""
    try:
        lat, lon, radius_m = (float(part) for part in [*text.split(","), str(_NEAR_M)][:3])
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not LAT,LON[,M], for example 47.3977,8.5456,300") from None
    if not (abs(lat) <= 80.0 and abs(lon) <= 180.0 and 10.0 <= radius_m <= 5000.0) or text.count(",") > 2:
        raise argparse.ArgumentTypeError(f"{text!r}: latitude to 80, longitude to 180 degrees, 10 to 5,000 m around it")
    return lat, lon, radius_m


def run(args: argparse.Namespace) -> int:
    """Make the map."""
    from orthoswarm.compute.workers import Processes, prepare_process

    prepare_process()
    # Objects of tens of thousands of photos live to the end: collecting garbage among them would cost a tenth of the
    # time.
    gc.set_threshold(100_000, 50, 50)
    from functools import partial

    import telemetry
    from gcs_plugin.cli.arguments import ProgressBars
    from orthoswarm.batch.pipeline import run as run_pipeline
    from orthoswarm.batch.run_state import is_written
    from orthoswarm.batch.workspace import VIDEO, missing, unmake
    from orthoswarm.matchers.network_device import require_device
    from orthoswarm.model.errors import InputError
    from orthoswarm.stores.addresses import is_stored
    from orthoswarm.stores.local_copies import compare_from_now
    from orthoswarm.stores.published_folder import PublishedFolder
    from telemetry.photos.photo_tags import band_name

    compare_from_now()
    _check(args)
    options = _options(args)

    require_device(options.config.matchers.device)

    def load(progress: "Progress") -> "Ingest":
        reading = telemetry.LoadOptions(
            every_m=args.every_m,
            every_s=args.every_s,
            cache=out / ".work" / VIDEO,
            exclude=(args.out,),
            camera=args.camera,
            band=band_name(args.band),
            sei_layouts=tuple(args.sei_layout),
            run=None if pool is None or (args.cluster and drawers is None) else pool.map,
        )
        ingest = telemetry.load(args.inputs, progress=progress, options=reading)
        if drawers is not None:
            _refuse_videos(ingest)
        if isinstance(pool, Processes) and args.workers is None:
            pool.fit(sum(frame.width * frame.height for frame in ingest.frames))
        return ingest

    if args.out.is_file():
        raise InputError(f"{args.out} is a file; choose a folder for --out")
    pool: Workers | None = None
    drawers: Workers | None = None
    published = PublishedFolder(args.out) if is_stored(args.out) else None
    out = args.out if published is None else published.local
    folders = missing(out) if published is None else published.folders()
    try:
        pool, drawers = _pools(args, out)
        with ProgressBars() as progress:
            publish = None if published is None else partial(published.publish, is_written, progress)
            report = run_pipeline(load, out, options, pool, progress, drawers=drawers, publish=publish)
    finally:
        for each in (pool, drawers):
            if each is not None:
                each.close()
        unmake(folders)
    if args.json:
        print(json_text(report, 1))
    else:
        _tell(report, args.out)
    return 0


def _options(args: argparse.Namespace) -> "MapOptions":
    """What the pipeline is asked for."""
    from orthoswarm.batch.run_state import MapOptions

    return MapOptions(**(given(args, MapOptions) | {"split_legs": args.split == "legs", "config": _config(args)}))


def _config(args: argparse.Namespace) -> "Config":
    """The settings: those of the file of --config, and flags over them."""
    from dataclasses import replace

    from orthoswarm.config import read_config

    config = read_config(args.config)
    return config if args.device is None else replace(config, matchers=replace(config.matchers, device=args.device))


def _pools(args: argparse.Namespace, out: Path) -> "tuple[Workers, Workers | None]":
    """What refines, and what draws if that is something else.

    Workers of a cluster draw where they see the output folder. Photos in a store need no folder that all see: the
    cluster refines then, and this machine draws.
    """
    from orthoswarm.compute.workers import workers
    from orthoswarm.model.errors import InputError
    from orthoswarm.stores.addresses import is_stored

    if not args.cluster:
        return workers(args.workers), None
    from orthoswarm.compute.dask_cluster import Cluster
    from orthoswarm.stores.local_copies import compare_from_now

    apart = all(map(is_stored, args.inputs))
    read = [p for p in (*args.inputs, args.basemap, args.dem) if p is not None and not is_stored(p)]
    if apart:
        return Cluster(args.cluster, read, begin=compare_from_now), workers(args.workers)
    if is_stored(args.out):
        raise InputError("with --cluster and photos in a folder, --out has to be a folder, too, that all workers see")
    out.mkdir(parents=True, exist_ok=True)  # the workers write there
    return Cluster(args.cluster, read, written=out, begin=compare_from_now), None


def _refuse_videos(ingest: "Ingest") -> None:
    """Pictures of videos are taken out on this machine, where a cluster does not see them."""
    from orthoswarm.model.errors import InputError

    if any("#" in frame.image for frame in ingest.frames):
        raise InputError("pictures of videos in a store are not seen by a cluster; leave out --cluster")


def _check(args: argparse.Namespace) -> None:
    """Refuse invalid values."""
    from orthoswarm.model.errors import InputError
    from orthoswarm.stores.addresses import is_stored
    from orthoswarm.stores.listing import exists

    if args.gsd_m is not None and not 0.001 <= args.gsd_m <= 100.0:
        raise InputError(f"--gsd {args.gsd_m:g} is not a ground pixel; give metres, for example 0.1")
    if args.fov_min_deg is not None and not 5.0 <= args.fov_min_deg <= 150.0:
        raise InputError(f"--fov-min {args.fov_min_deg:g} is not a field of view; give degrees, for example 70")
    for flag, value in (("--every-m", args.every_m), ("--every-s", args.every_s)):
        if value is not None and not value > 0.0:
            raise InputError(f"{flag} must be larger than zero; leave it out for the default")
    if args.workers is not None and args.workers < 1:
        raise InputError(f"--workers {args.workers} is too few; give 1 or more")
    if args.near is not None and args.basemap is None:
        raise InputError("--near says where on the basemap photos are looked for; give one with --basemap")
    if args.unreferenced and (any(getattr(args, name) is not None for name in _PLACING) or args.until != "fine"):
        raise InputError(f"--unreferenced goes without {', '.join(f'--{name}' for name in _PLACING)} and --until")
    if args.unreferenced and is_stored(args.out):
        raise InputError("--unreferenced writes into a folder of this machine; name one for --out")
    if args.temperature is not None and (
        args.until != "fine" or args.unreferenced or not 0.0 <= args.temperature <= 1.0
    ):
        raise InputError("--temperature takes kelvin a count (0.04), and goes without --until and --unreferenced")
    if args.tone == "map":
        if args.basemap is None:
            raise InputError("--tone map takes brightness and hue from a basemap; give one with --basemap")
        if not args.gains or args.until != "fine":
            raise InputError("--tone map needs balanced, refined pictures; leave out --no-gains and --until")
    if args.quick and (args.until == "realtime" or args.surface is not None):
        raise InputError("--quick draws the refined map; leave out --until realtime and --surface")
    if args.control is not None and args.until == "realtime":
        raise InputError("--control moves refined pictures; leave out --until realtime")
    if not args.pixel_scale > 0.0:
        raise InputError("--pixel-scale must be greater than 0; leave it out for points marked in these photos")
    for flag in ("surface", "control", "checkpoints"):
        path = getattr(args, flag)
        if path is not None and is_stored(path):
            raise InputError(f"--{flag} {address_of(path)} is an address; name a file on this machine")
    files = (
        ("--basemap", args.basemap),
        ("--dem", args.dem),
        ("--control", args.control),
        ("--checkpoints", args.checkpoints),
    )
    for flag, path in files:
        if path is not None and not exists(path):
            raise InputError(f"{flag} {address_of(path)} does not exist; check the path")
    _check_written(args)


def _check_written(args: argparse.Namespace) -> None:
    """Refuse to write over an input, and to write two products into one file."""
    from gcs_plugin.cli.arguments import refuse_product, refuse_replacing
    from orthoswarm.batch.run_state import WRITTEN
    from orthoswarm.model.errors import InputError

    flags = ("basemap", "dem", "control", "checkpoints", "config")
    read = {f"--{flag}": getattr(args, flag) for flag in flags}
    read |= {f"--sei-layout {path}": path for path in args.sei_layout} | {f"INPUT {path}": path for path in args.inputs}
    for name, path in read.items():
        if path is not None:
            refuse_product(name.split()[0], path, args.out, WRITTEN)
    if args.surface is None:
        return
    if args.surface.suffix.lower() not in (".tif", ".tiff") or args.surface.is_dir():
        raise InputError(f"--surface {args.surface} is not the name of a GeoTIFF; end it in .tif")
    if args.until == "realtime" or args.refine != "swarm":
        raise InputError("--surface needs the refined pictures; leave out --until realtime and --refine paper")
    refuse_product("--surface", args.surface, args.out, WRITTEN)
    refuse_replacing("--surface", args.surface, read)
    folders = {path.resolve() for path in args.inputs if path.is_dir()}
    if args.surface.exists() and not folders.isdisjoint(args.surface.resolve().parents):
        from orthoswarm.export.value_raster import is_surface

        if not is_surface(args.surface):
            raise InputError(f"--surface {args.surface} would replace a file of INPUT; choose another name")


def _tell(report: dict[str, object], out: Path) -> None:
    """Print a few lines for people."""
    import sys

    frames = report["frames"]
    assert isinstance(frames, dict)
    print(f"{frames['used']} of {frames['input']} pictures mapped in {report['wall_s']:.0f} s: {address_of(out)}")
    if report["headline"]:
        print(report["headline"])
    left_out = report["left_out"]
    assert isinstance(left_out, dict)
    reasons = list(left_out.items())
    for reason, count in reasons[:_REASONS]:
        print(f"left out: {count}: {reason}", file=sys.stderr)
    if len(reasons) > _REASONS:
        rest = sum(count for _, count in reasons[_REASONS:])
        print(f"left out: {rest} more, see {address_of(out / 'report.html')}", file=sys.stderr)
    warnings = report["warnings"]
    assert isinstance(warnings, list)
    for warning in warnings:
        print(f"note: {warning}", file=sys.stderr)

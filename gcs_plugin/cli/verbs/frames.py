"""`orthoswarm frames`: the pictures of a video as JPEG files with their poses."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from orthoswarm.export.json_values import json_text

if TYPE_CHECKING:
    from orthoswarm.model.frame import Frame


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "Each vehicle gets a folder of JPEG files with position, time and attitude in EXIF and XMP, as OpenDroneMap,\n"
        "QGIS and this program read them. Photos are copied with what a geo.txt or CSV beside them adds.\n\n"
        "example:\n  orthoswarm frames flight.mp4 --out pictures --every-m 5"
    )
    add = parser.add_argument
    add("inputs", nargs="+", type=Path, metavar="INPUT", help="videos, or folders with videos or photos")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the pictures")
    add("--every-m", type=float, metavar="M", help="one picture every M metres (default: 4 %% of the height)")
    add("--every-s", type=float, metavar="S", help="one picture every S seconds")
    add(
        "--sei-layout", type=Path, action="append", default=[], metavar="FILE",
        help="TOML file that describes a private SEI message (docs/telemetry.md)",
    )  # fmt: skip
    add("--json", action="store_true", help="print what was written as one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Extract the pictures."""
    import sys
    import tempfile
    from contextlib import suppress

    from gcs_plugin.cli.arguments import ProgressBars
    from orthoswarm.compute.workers import prepare_process
    from orthoswarm.model.errors import InputError, OrthoSwarmError

    prepare_process()
    from orthoswarm.mosaic.recorded_pose import nothing_to_map
    from telemetry.ingest.ingest import LoadOptions, load

    for name, value in (("--every-m", args.every_m), ("--every-s", args.every_s)):
        if value is not None and not value > 0:
            raise InputError(f"{name} must be larger than zero; leave it out for the default")
    if args.out.is_file():
        raise InputError(f"{args.out} is a file; choose a folder for --out")
    new = not args.out.exists()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=args.out, prefix=".taking-") as cache, ProgressBars() as progress:
            layouts = tuple(args.sei_layout)
            options = LoadOptions(
                every_m=args.every_m, every_s=args.every_s, cache=Path(cache), exclude=(args.out,), sei_layouts=layouts
            )
            found = load(args.inputs, progress=progress, options=options)
            if not found.frames:
                raise nothing_to_map(found)
            used_names: set[Path] = set()
            written = [write(frame, args.out, used_names) for frame in found.frames]
            progress("writing pictures", len(written), len(written))
    except OSError as error:
        raise OrthoSwarmError(
            f"{args.out} cannot be written ({error.strerror}); free space or choose another"
        ) from None
    except OrthoSwarmError:
        if new:
            with suppress(OSError):
                args.out.rmdir()
        raise
    if args.json:
        document = {
            "written": [
                {"file": str(path), "image": frame.image, "vehicle": frame.vehicle, "time_s": frame.time_s}
                for path, frame in zip(written, found.frames, strict=True)
            ],
            "rejected": [{"image": r.image, "reason": r.text} for r in found.rejected],
            "warnings": found.warnings,
        }
        print(json_text(document, 1))
    else:
        for warning in found.warnings:
            print(f"! {warning}", file=sys.stderr)
        for rejection in found.rejected:
            print(f"x {rejection.image}: {rejection.text}", file=sys.stderr)
        vehicles = len({frame.vehicle for frame in found.frames})
        print(f"{len(written)} pictures of {vehicles} vehicle(s) in {args.out}")
    return 0


def write(frame: "Frame", out: Path, used_names: set[Path]) -> Path:
    """Write one frame's picture with its pose; returns the file, whose unique name is added to those in use.

    Raises:
        OSError: it cannot be written.
    """
    import os

    from orthoswarm.raster.picture_file import read_rgb
    from telemetry.videos.extraction import encode_jpeg
    from telemetry.write.tag_writer import with_pose

    folder = out.joinpath(*(_safe(part) for part in frame.vehicle.split("/")))
    folder.mkdir(parents=True, exist_ok=True)
    stem, _, number = frame.image.rsplit("/", 1)[-1].partition("#")
    name = _safe(Path(stem).stem + (f"_{number}" if number else ""))
    target = folder / f"{name}.jpg"
    again = 1
    while _key(target) in used_names:  # two files of the same name, in folders of one vehicle or with other suffixes
        again += 1
        target = folder / f"{name}-{again}.jpg"
    used_names.add(_key(target))
    data = frame.path.read_bytes()
    if data[:2] != b"\xff\xd8":
        data = encode_jpeg(read_rgb(frame.path))
    temporary = folder / f".{target.name}.part"
    temporary.write_bytes(with_pose(data, frame))
    os.replace(temporary, target)
    return target


def _key(path: Path) -> Path:
    """A key that is equal for names of one file on case-insensitive systems."""
    return path.with_name(path.name.casefold())


def _safe(name: str) -> str:
    """A file name that is valid on every system."""
    safe = "".join(c if c.isalnum() or c in "-_. " else "_" for c in name).strip(" .")
    return safe or "_"

"""`orthoswarm evaluate`: an orthoimage against a reference or surveyed points, placed frames against true cameras."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from orthoswarm.export.json_values import json_text
from orthoswarm.model.errors import InputError, OrthoSwarmError

if TYPE_CHECKING:
    from orthoswarm.evaluation.displacement import Accuracy

_WAIT_S: Final = 600.0  # of a refinement and its files on a busy machine
_LOOK_S: Final = 0.5


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "completeness is the covered share of the ground within the convex hull of what is covered: holes count, what\n"
        "is missing at the edge does not; with --truth, seen_share is that of all ground that the cameras saw.\n\n"
        "example:\n  orthoswarm evaluate out/orthoimage.tif --reference twin/truth/reference.tif \\\n"
        "      --poses out/frames.jsonl --truth twin/truth/frames.csv --json\n"
        "  orthoswarm evaluate out --checkpoints gcp_list.txt"
    )
    add = parser.add_argument
    add(
        "ortho", type=Path, metavar="ORTHO.tif|OUT", nargs="?",
        help="the orthoimage (alpha or nodata says where it has ground), or the output folder that holds it",
    )  # fmt: skip
    add("--reference", type=Path, metavar="REF.tif", help="a picture of the true ground to measure it against")
    add(
        "--checkpoints", type=Path, metavar="FILE",
        help="surveyed points to measure it at: ODM's gcp_list.txt, or a CSV with name, lat_deg, lon_deg (or east_m, "
        "north_m, epsg), sigma_m, and image, column, row (or map_lat_deg, map_lon_deg)",
    )  # fmt: skip
    add(
        "--pixel-scale", type=float, default=1.0, metavar="S",
        help="for checkpoints measured in larger copies of the photos: pixels of the mapped photos to one of those",
    )  # fmt: skip
    add(
        "--mask",
        metavar="MASK.tif",
        help="compare only where this is not 0 (default: ground_mask.tif beside the reference; none: no mask)",
    )
    add("--poses", type=Path, metavar="FRAMES.jsonl", help="placed frames of the same product")
    add("--truth", type=Path, metavar="FRAMES.csv", help="the true cameras")
    add(
        "--live", type=Path, metavar="WORKSPACE",
        help="with --truth: where a daemon drew pictures first, in flight, by what placed them",
    )  # fmt: skip
    add("--gsd", type=float, metavar="M", help="pixel at which both are compared (default 0.3, or what they have)")
    add("--search", type=float, default=8.0, metavar="M", help="largest displacement that is looked for (default 8)")
    add("--field", type=Path, metavar="FIELD.csv", help="write the field of displacements")
    add(
        "--wait", type=float, nargs="?", const=_WAIT_S, metavar="SECONDS",
        help="wait until the orthoimage is there, and that of a daemon has all that is refined (at most SECONDS, 600)",
    )  # fmt: skip
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    if args.live is not None:
        return _live(args)
    if args.ortho is None:
        raise InputError("say what to evaluate: an orthoimage or the folder that holds it, or --live WORKSPACE")
    if (args.poses is None) != (args.truth is None):
        raise InputError("--poses and --truth belong together; give both or none")
    if args.reference is None and args.checkpoints is None:
        raise InputError("say what to measure against: --reference REF.tif or --checkpoints FILE")
    if args.reference is None and (args.poses is not None or args.field is not None):
        raise InputError("--poses and --field need --reference")
    if not args.pixel_scale > 0.0:
        raise InputError("--pixel-scale must be greater than 0")
    if args.field is not None:
        from gcs_plugin.cli.arguments import refuse_replacing, require_folder_for

        read = ("ortho", "reference", "checkpoints", "poses", "truth")
        refuse_replacing("--field", args.field, {name: getattr(args, name) for name in read})
        require_folder_for("--field", args.field)
    if args.wait is not None and not args.wait >= 0.0:
        raise InputError("--wait must be 0 or more seconds")
    if args.wait is not None:
        _wait(args)
    figures: dict[str, Any] = {}
    if args.reference is not None:
        figures |= _against_reference(args)
    if args.checkpoints is not None:
        from orthoswarm.evaluation.checkpoints import evaluate_checkpoints

        figures |= evaluate_checkpoints(args.ortho, args.checkpoints, args.pixel_scale).figures()
    figures |= _of_the_drawing(args.ortho)
    if args.json:
        print(json_text(figures))
    else:
        _print(figures)
    return 0


def _live(args: argparse.Namespace) -> int:
    """Print where pictures were drawn first."""
    if args.truth is None or args.ortho is not None:
        raise InputError("--live WORKSPACE needs --truth FRAMES.csv, and no orthoimage")
    from gcs_plugin.bench.accuracy import live_errors

    found = live_errors(args.live, args.truth)
    if args.json:
        print(json_text(found))
        return 0
    for by, f in found.items():
        print(
            f"{by}: {f['pictures']} pictures, {f['median_m']:.2f} m median, {f['p95_m']:.2f} m 95 %; within one and "
            f"two sigma {f['sigma_1']:.0f} and {f['sigma_2']:.0f} %; on the map after {f['after_median_s']:.2f} s, "
            f"95 % within {f['after_p95_s']:.2f} s"
        )
    return 0


def _of_the_drawing(ortho: Path) -> dict[str, Any]:
    """What the run that drew it said of it, where its report.json is there."""
    report = (ortho if ortho.is_dir() else ortho.parent) / "report.json"
    if not report.is_file():
        return {}
    said = json.loads(report.read_text("utf-8"))
    own = {"drawn_twice_share": said.get("drawn_twice_share"), **said.get("trust", {})}
    return {name: value for name, value in own.items() if value is not None}


def _wait(args: argparse.Namespace) -> None:
    """Wait until the orthoimage is there and, in a daemon's workspace, was written after the last refinement."""
    from gcs_plugin.daemon.store.journal import wrote_refined
    from orthoswarm.export.catalog.tiled_raster import product_file

    ortho = args.ortho / "orthoimage.tif" if args.ortho.is_dir() or not args.ortho.suffix else args.ortho
    for path in (ortho.parent, args.reference, args.checkpoints, args.truth):
        if path is not None and not path.exists():
            raise InputError(f"{path} does not exist; nothing was waited for")
    end, what = time.monotonic() + args.wait, f"until {ortho} is there and has all that is refined"
    print(f"waiting {what}", file=sys.stderr, flush=True)
    while product_file(ortho.parent, ortho.name) is None or not wrote_refined(ortho.parent):
        if time.monotonic() >= end:
            raise OrthoSwarmError(f"waited {args.wait:g} s {what}; see on the daemon's page what it does")
        time.sleep(_LOOK_S)


def _against_reference(args: argparse.Namespace) -> dict[str, Any]:
    from orthoswarm.evaluation.displacement import FieldSettings
    from orthoswarm.evaluation.orthoimage import evaluate_ortho, find_mask, seen_share
    from orthoswarm.evaluation.true_cameras import evaluate_poses, read_truth
    from orthoswarm.export.catalog.tiled_raster import product_file

    ortho = args.ortho
    if ortho.is_dir():
        ortho = product_file(ortho, "orthoimage.tif") or ortho / "orthoimage.tif"
    mask = find_mask(args.reference, args.mask)
    result = evaluate_ortho(ortho, args.reference, mask, FieldSettings(search_m=args.search), args.gsd)
    figures: dict[str, Any] = dict(result.figures())
    figures["mask"] = None if mask is None else mask.name
    if args.poses is not None:
        figures["poses"] = evaluate_poses(args.poses, args.truth).figures()
        figures["seen_share"] = seen_share(ortho, [camera for _, _, camera in read_truth(args.truth).values()])
    if args.field is not None:
        _write_field(args.field, result)
    return figures


def _write_field(path: Path, result: "Accuracy") -> None:
    import numpy as np

    f = result.field
    table = np.c_[f.position, f.shift_m, f.peak]
    np.savetxt(path, table, "%.4f", ",", header="column,row,east_m,north_m,peak", comments="")


def _print(figures: dict[str, Any]) -> None:
    for name, value in figures.items():
        if isinstance(value, dict):
            print(f"{name}:")
            for key, inner in value.items():
                print(f"  {key:<24} {_text(inner)}")
        else:
            print(f"{name:<26} {_text(value)}")


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}"
    if isinstance(value, dict):
        return ", ".join(f"{k} {_text(v)}" for k, v in value.items())
    if isinstance(value, list):
        return "; ".join(_text(v) for v in value) or "-"
    return "-" if value is None else str(value)

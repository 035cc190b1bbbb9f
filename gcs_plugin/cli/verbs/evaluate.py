"""`orthoswarm evaluate`: an orthoimage against a reference, placed frames against true cameras."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from orthoswarm.evaluation.displacement import Accuracy


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "completeness is the covered share of the ground within the convex hull of what is covered: holes count, what\n"
        "is missing at the edge does not; with --truth, seen_share is that of all ground that the cameras saw.\n\n"
        "example:\n  orthoswarm evaluate out/orthoimage.tif --reference twin/truth/reference.tif \\\n"
        "      --poses out/frames.jsonl --truth twin/truth/frames.csv --json"
    )
    add = parser.add_argument
    add("ortho", type=Path, metavar="ORTHO.tif", help="the orthoimage (alpha or nodata says where it has ground)")
    add("--reference", type=Path, required=True, metavar="REF.tif", help="what it is measured against")
    add(
        "--mask",
        metavar="MASK.tif",
        help="compare only where this is not 0 (default: ground_mask.tif beside the reference; none: no mask)",
    )
    add("--poses", type=Path, metavar="FRAMES.jsonl", help="placed frames of the same product")
    add("--truth", type=Path, metavar="FRAMES.csv", help="the true cameras")
    add("--gsd", type=float, metavar="M", help="pixel at which both are compared (default 0.3, or what they have)")
    add("--search", type=float, default=8.0, metavar="M", help="largest displacement that is looked for (default 8)")
    add("--field", type=Path, metavar="FIELD.csv", help="write the field of displacements")
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    from orthoswarm.evaluation.displacement import FieldSettings
    from orthoswarm.evaluation.orthoimage import evaluate_ortho, find_mask, seen_share
    from orthoswarm.evaluation.true_cameras import evaluate_poses, read_truth
    from orthoswarm.model.errors import InputError

    if (args.poses is None) != (args.truth is None):
        raise InputError("--poses and --truth belong together; give both or none")
    mask = find_mask(args.reference, args.mask)
    result = evaluate_ortho(args.ortho, args.reference, mask, FieldSettings(search_m=args.search), args.gsd)
    figures: dict[str, Any] = dict(result.figures())
    figures["mask"] = None if mask is None else mask.name
    if args.poses is not None:
        figures["poses"] = evaluate_poses(args.poses, args.truth).figures()
        figures["seen_share"] = seen_share(args.ortho, [camera for _, _, camera in read_truth(args.truth).values()])
    if args.field is not None:
        _write_field(args.field, result)
    if args.json:
        print(json.dumps(figures))
    else:
        _print(figures)
    return 0


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
        return ", ".join(_text(v) for v in value)
    return "-" if value is None else str(value)

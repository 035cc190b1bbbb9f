"""`orthoswarm weights`: the weights of learned matchers: list, import and test them."""

import argparse
import json
from pathlib import Path
from time import perf_counter
from typing import Any

from orthoswarm.model.errors import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "Nothing is ever downloaded: bring files on a stick, or install the packages that ship them beforehand.\n\n"
        "example:\n  orthoswarm weights list\n  orthoswarm weights import /media/stick/weights\n"
        "  orthoswarm weights check"
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="list|import|check")
    listing = _action(actions, "list", "which weights are known, where they lie, which matchers use them")
    bring_help = "copy a file of weights, or all known ones of a folder, to your own folder"
    bring = _action(actions, "import", bring_help, " /media/stick/weights")
    bring.add_argument("source", type=Path, metavar="FILE|DIR", help="file or folder with weights")
    check = _action(actions, "check", "compare files with the published ones and run each matcher once")
    for sub in (listing, bring, check):
        sub.add_argument("--json", action="store_true", help="one JSON document on stdout")


def _action(actions: Any, name: str, text: str, example: str = "") -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = actions.add_parser(
        name,
        help=text,
        description=text[0].upper() + text[1:] + ".",
        epilog=f"example:\n  orthoswarm weights {name}{example}",
    )
    return parser


def run(args: argparse.Namespace) -> int:
    """List, import or check."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    from orthoswarm.matchers import weight_files

    ok = True
    rows: list[dict[str, Any]]
    columns: tuple[str, ...]
    if args.action == "list":
        rows = [describe(w) for w in weight_files.KNOWN.values()]
        columns = ("name", "state", "matchers", "path")
    elif args.action == "import":
        rows = [
            {"name": w.name, "state": "imported", "path": str(p)} for w, p in weight_files.import_weights(args.source)
        ]
        columns = ("name", "state", "path")
    else:
        rows = [*checked_files(), *checked_matchers()]
        columns = ("name", "state", "detail")
        ok = not any(row["state"] == "damaged" for row in rows)
    if args.json:
        print(json.dumps(rows, indent=1))
    else:
        _print(rows, columns)
    return 0 if ok else 1


def describe(weight: Any) -> dict[str, Any]:
    """One row of the list."""
    from orthoswarm.matchers import weight_files

    path = weight_files.find(weight.name)
    return {
        "name": weight.name,
        "state": "here" if path else "missing",
        "matchers": ", ".join(weight.used_by),
        "licence": weight.licence,
        "path": str(path) if path else weight_files.how_to_get(weight),
    }


def checked_files() -> list[dict[str, Any]]:
    """Installed files, compared with the published ones."""
    from orthoswarm.matchers import weight_files

    rows = []
    for weight in weight_files.KNOWN.values():
        path = weight_files.find(weight.name)
        if path is None:
            rows.append({"name": weight.name, "state": "missing", "detail": weight_files.how_to_get(weight)})
        elif weight.sha256 is None:
            rows.append({"name": weight.name, "state": "here", "detail": f"{path} (no published sum to compare with)"})
        elif weight_files.digest(path) == weight.sha256:
            rows.append({"name": weight.name, "state": "good", "detail": str(path)})
        else:
            rows.append({"name": weight.name, "state": "damaged", "detail": f"{path} is not the published file"})
    return rows


def checked_matchers() -> list[dict[str, Any]]:
    """Run every built-in matcher once on a synthetic picture and its shifted copy."""
    import cv2
    import numpy as np

    from orthoswarm.matchers import map_matcher, picture_matcher
    from orthoswarm.matchers.matcher import UnavailableError
    from orthoswarm.matchers.registry import MAP, PICTURE

    rng = np.random.default_rng(1)
    ground = sum(
        cv2.resize(rng.uniform(0, 255, (512 // s, 512 // s)).astype(np.float32), (512, 512)) / 4 for s in (4, 8, 16, 32)
    )
    ground = np.asarray(ground, np.float32)
    rows = []
    for name in (*PICTURE, *MAP):
        began = perf_counter()
        try:
            if name in PICTURE:
                a, b = (np.clip(g, 0, 255).astype(np.uint8) for g in (ground[8:232, :224], ground[16:240, :224]))
                count, wanted = picture_matcher(name).match(a, b), np.array([0.0, -8.0])
            else:
                patch, valid = ground[48:368, 48:368], np.ones((320, 320), bool)
                count = map_matcher(name).match(patch, valid, ground[24:408, 32:416], np.ones((384, 384), bool), 32)
                wanted = np.array([16.0, 24.0])
            right = int((np.abs(count.b - count.a - wanted).max(1) < 4).sum()) if len(count) else 0
            detail = f"{right} right matches on a made-up picture, {perf_counter() - began:.1f} s"
            rows.append({"name": f"matcher {name}", "state": "good" if right >= 4 else "damaged", "detail": detail})
        except (InputError, UnavailableError) as error:
            rows.append({"name": f"matcher {name}", "state": "missing", "detail": str(error)})
    return rows


def _print(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> None:
    widths = [max(len(str(row[c])) for row in rows) for c in columns[:-1]]
    for row in rows:
        print("  ".join([*(f"{row[c]:<{w}}" for c, w in zip(columns, widths, strict=False)), str(row[columns[-1]])]))

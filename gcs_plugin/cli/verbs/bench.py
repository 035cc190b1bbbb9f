"""`orthoswarm bench`: accuracy and cost on sets with truth, and how cost grows.

Every map is made by the `mosaic` verb in its own process, as by a user, so that times and memory are
complete and comparable. Results are kept: an interrupted benchmark continues, and more sets can be added.
"""

import argparse
import json
import signal
import sys
from pathlib import Path
from typing import Any

from orthoswarm.model.errors import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "A SET is a folder of `orthoswarm twin make`: photos, basemap.tif, truth. Results lie in DIR, one file for\n"
        "each run; a run whose file is there is not repeated. Maps are removed unless --keep is given.\n\n"
        "example:\n  orthoswarm twin make debris --out sets/debris\n"
        "  orthoswarm bench accuracy sets/debris --out bench\n"
        "  orthoswarm bench scaling sets/debris --vehicles 1,2,3 --images 85,170,339 --out bench"
    )
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="accuracy|scaling")
    accuracy = kinds.add_parser(
        "accuracy", help="do nothing, the paper, swarm, true poses: error, cost, memory",
        epilog="example:\n  orthoswarm bench accuracy sets/debris --methods swarm,truth --out bench",
    )  # fmt: skip
    accuracy.add_argument("sets", nargs="+", type=Path, metavar="SET", help="folders of `twin make`")
    methods = "nothing,paper,swarm,truth"
    accuracy.add_argument("--methods", default=methods, metavar="LIST", help=f"some of {methods} (default all)")
    scaling = kinds.add_parser(
        "scaling", help="time against vehicles (Fig. 7) and pictures a vehicle (Fig. 8)",
        epilog="example:\n  orthoswarm bench scaling sets/debris --vehicles 1,2,3 --images 85,170,339 --out bench",
    )  # fmt: skip
    scaling.add_argument("sets", nargs=1, type=Path, metavar="SET", help="a folder of `twin make`")
    scaling.add_argument(
        "--vehicles", default="1,2,3,4,8,16,32,64,96", help="numbers of vehicles (default %(default)s)"
    )
    scaling.add_argument("--images", default="42,85,170,339", help="pictures a vehicle (default %(default)s)")
    scaling.add_argument("--refine", default="swarm", help="which refiner (default %(default)s)")
    scaling.add_argument("--figures", type=Path, metavar="DIR", help="folder for pictures (default: that of --out)")
    for sub in (accuracy, scaling):
        sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for results")
        sub.add_argument("--keep", action="store_true", help="keep the maps")
        sub.add_argument("--json", action="store_true", help="one JSON document on stdout")
        sub.add_argument("--workers", type=int, metavar="N", help="processes at once (default: one a core)")


def run(args: argparse.Namespace) -> int:
    """Measure."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    from gcs_plugin.bench.benchmark_runs import check_set, write_result

    for folder in args.sets:
        check_set(folder)
    args.out.mkdir(parents=True, exist_ok=True)
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that a measured program is ended, too
    try:
        result, table = {"accuracy": _accuracy, "scaling": _scaling}[args.kind](args)
    finally:
        signal.signal(signal.SIGTERM, before)
    write_result(args.out / f"{args.kind}.json", result)
    (args.out / f"{args.kind}.md").write_text(table, encoding="utf-8")
    print(json.dumps(result) if args.json else table)
    return 0 if any("error" not in row for row in result["rows"]) else 1


def _accuracy(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from gcs_plugin.bench.accuracy import METHODS, accuracy_table, run_accuracy

    methods = [part.strip() for part in args.methods.split(",") if part.strip()]
    if not methods or set(methods) - set(METHODS):
        raise InputError(f"--methods takes some of {', '.join(METHODS)}; give them with commas between")
    result = run_accuracy(args.sets, methods, args.out, args.workers, args.keep)
    return result, accuracy_table(result)


def _scaling(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from gcs_plugin.bench.benchmark_runs import numbers
    from gcs_plugin.bench.scaling import plot_scaling, run_scaling, scaling_table

    counts, images = numbers(args.vehicles, "--vehicles"), numbers(args.images, "--images")
    result = run_scaling(
        args.sets[0], counts, images, refine=args.refine, out=args.out, workers=args.workers, maps=args.keep
    )
    plot_scaling(result, args.figures or args.out)
    return result, scaling_table(result)

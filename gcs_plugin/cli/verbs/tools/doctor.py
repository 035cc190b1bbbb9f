"""`orthoswarm doctor`: what this machine has, and what each missing thing costs."""

import argparse
from collections.abc import Callable
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = "example:\n  orthoswarm doctor --warm"
    add = parser.add_argument
    add("--warm", action="store_true", help="compile kernels now, so that the first run in the field does not wait")
    add(
        "--workspace",
        type=Path,
        default=Path("."),
        metavar="DIR",
        help="folder whose disk is checked (default: here)",
    )
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Check the machine."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    import json
    import sys
    from dataclasses import asdict

    from gcs_plugin.cli.machine_check import checks, warm_kernels

    if args.warm:
        seconds = warm_kernels(_say(sys.stderr.write))
        print(f"kernels are compiled ({seconds:.0f} s)", file=sys.stderr)
    found = checks(args.workspace)
    if args.json:
        document = {"ok": all(c.ok or not c.needed for c in found), "checks": [asdict(c) for c in found]}
        print(json.dumps(document, indent=1, ensure_ascii=False))
        return 0
    width = max(len(c.name) for c in found)
    for check in found:
        mark = "ok" if check.ok else "MISSING" if check.needed else "absent"
        print(f"{check.name:<{width}}  {mark:<7}  {check.detail}")
        if not check.ok and check.cost:
            print(f"{'':<{width}}           {check.cost}")
    return 0


def _say(write: Callable[[str], int]) -> Callable[[str], None]:
    def say(text: str) -> None:
        write(text + "\n")

    return say

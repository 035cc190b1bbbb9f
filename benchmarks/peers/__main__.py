"""Other programs on the same photos (the paper's Table I).

    python -m benchmarks.peers sets/debris --every 3 --out bench

Runs other programs in environments of their own, made with pip on first use, and judges their maps by the true map.
Linux only. A SET is a folder of `orthoswarm twin make`. Results lie in DIR, one file for each run; a run whose file is
there is not repeated.
"""

import argparse
import signal
import sys
from pathlib import Path

from benchmarks.peers.programs import PeerSettings, peers_sheet, peers_table, run_peers
from gcs_plugin.bench.benchmark_runs import check_set, write_result
from orthoswarm.compute.workers import prepare_process
from orthoswarm.model.errors import InputError, OrthoSwarmError

PROGRAMS = "swarm,paper,pyorthomosaic,stitcher,pycolmap"


def parsed(argv: list[str] | None) -> argparse.Namespace:
    """The arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("sets", nargs="+", type=Path, metavar="SET", help="folders of `twin make`")
    add("--programs", default=PROGRAMS, metavar="LIST", help=f"some of {PROGRAMS} (default all)")
    add("--every", type=int, default=1, metavar="N", help="use every N-th photo of a vehicle (default 1)")
    add("--limit-s", type=float, default=900.0, metavar="S", help="CPU seconds for a program and set (default 900)")
    add("--environments", type=Path, metavar="DIR", help="where they are (default environments in --out)")
    add("--figures", type=Path, metavar="DIR", help="folder for pictures (default: that of --out)")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for results")
    add("--keep", action="store_true", help="keep the maps")
    add("--workers", type=int, default=1, metavar="N", help="threads of each program (default 1)")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Measure, and print the table."""
    args = parsed(argv)
    prepare_process()
    out = args.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    settings = PeerSettings(
        programs=tuple(name.strip() for name in args.programs.split(",") if name.strip()), out=out,
        environments=args.environments or out / "environments", limit_s=args.limit_s, every=args.every,
        threads=args.workers, keep_maps=args.keep,
    )  # fmt: skip
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that a measured program is ended, too
    try:
        if args.every < 1 or args.limit_s <= 0 or args.workers < 1:
            raise InputError("--every, --limit-s and --workers take numbers above 0")
        for folder in args.sets:
            check_set(folder)
        result = run_peers(args.sets, settings)
    except OrthoSwarmError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    finally:
        signal.signal(signal.SIGTERM, before)
    thin = f"-every{args.every}" if args.every > 1 else ""
    peers_sheet(result, settings, (args.figures or out) / f"peers{thin}.jpg")
    table = peers_table(result)
    write_result(out / f"peers{thin}.json", result)
    (out / f"peers{thin}.md").write_text(table, encoding="utf-8")
    print(table)
    return 0 if any("error" not in row for row in result["rows"]) else 1


if __name__ == "__main__":
    sys.exit(main())

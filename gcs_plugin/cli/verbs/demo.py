"""`orthoswarm demo`: a simulated swarm, end to end, no files and no autopilot needed."""

import argparse
import json
import os
import sys
from pathlib import Path

from orthoswarm.model.errors import InputError, OrthoSwarmError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "A city after a disaster, a plan, vehicles that fly it, cameras that stream it, the daemon that maps it;\n"
        "each vehicle is refined as it completes its mission. A slow machine flies slower; it ends by itself.\n\n"
        "example:\n  orthoswarm demo --vehicles 3 --out out/demo"
    )
    add = parser.add_argument
    add("--vehicles", type=int, default=3, metavar="N", help="how many (default 3)")
    add("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="where the map goes (default out/demo)")
    add("--port", type=int, default=0, metavar="P", help="of the web page while it runs (default: any free one)")
    add("--seed", type=int, default=1, metavar="S", help="another city, another wind (default 1)")
    add("--speed", type=float, default=6.0, metavar="X", help="simulated seconds in a second at most (default 6)")
    add("--median", type=float, metavar="M", help="fail if the map's median error is larger")
    add("--no-browser", action="store_true", help="do not open the page, even on a terminal with a display")
    add("--json", action="store_true", help="print the report as one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Run the demonstration."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()

    from gcs_plugin.cli.arguments import ProgressBars
    from gcs_plugin.cli.verbs.doctor import compile_cold_kernels
    from gcs_plugin.demo.demonstration import run_demo
    from gcs_plugin.demo.simulated_camera import DemoSetting

    if not 1 <= args.vehicles <= 12:
        raise InputError(f"{args.vehicles} vehicles are not possible here; choose 1 to 12")
    if not 0.2 <= args.speed <= 20.0:
        raise InputError(f"a speed of {args.speed:g} is not possible; choose 0.2 to 20")

    def opened(url: str) -> None:
        print(f"map: {url}", file=sys.stderr, flush=True)
        if not args.no_browser and sys.stdout.isatty() and any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
            import webbrowser

            webbrowser.open(url)

    with ProgressBars() as progress:
        setting = DemoSetting(args.vehicles, args.seed, args.speed)
        report = run_demo(setting, args.out, progress, port=args.port, opened=opened, prepare=compile_cold_kernels)
    accuracy = report["accuracy"]
    if args.json:
        json.dump(report, sys.stdout, indent=1, ensure_ascii=False)
        print()
    else:
        _tell(report, args.out)
    median = accuracy["median_m"]
    if args.median is not None and (median is None or median > args.median):
        raise OrthoSwarmError(f"the map's median error is {median} m, more than the {args.median:g} m that were asked")
    return 0


def _tell(report: dict[str, object], out: Path) -> None:
    """Print a few lines for people."""
    accuracy, realtime, completions = report["accuracy"], report["accuracy_realtime"], report["completions"]
    assert isinstance(accuracy, dict) and isinstance(realtime, dict) and isinstance(completions, list)
    for row in completions:
        seconds = row["refine_ended_s"] - row["complete_s"]
        flying = ", ".join(row["still_flying"]) or "nobody"
        print(f"{row['vehicle']} completed; refined on the map {seconds:.1f} s later; still flying: {flying}")
    print(f"median error: {realtime['median_m']:.2f} m in real time, {accuracy['median_m']:.2f} m refined")
    print(f"the map: {out / 'orthoimage.tif'}, what it took: {out / 'report.html'}")
    print(f"the page again: orthoswarm serve --workspace {out} --basemap {out / 'twin' / 'basemap.tif'}")

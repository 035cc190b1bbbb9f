"""`orthoswarm bench`: accuracy and cost on sets with truth; how cost grows with vehicles and pictures.

Every map is made by the `mosaic` verb in a process of its own, as a user would make it, so that times and memory are
whole and comparable. What is measured already is kept: an interrupted benchmark goes on.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

METHODS = ("nothing", "paper", "swarm", "truth")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "A SET is a folder of `orthoswarm twin make`: photos, basemap.tif, truth.\n\n"
        "example:\n  orthoswarm twin make debris --out sets/debris\n"
        "  orthoswarm bench accuracy sets/debris --out bench\n"
        "  orthoswarm bench scaling sets/debris --vehicles 1,2,3 --images 85,170,339 --out bench"
    )
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="accuracy|scaling")
    accuracy = kinds.add_parser("accuracy", help="do nothing, the paper, swarm, true poses: error, cost, memory")
    accuracy.add_argument("sets", nargs="+", type=Path, metavar="SET", help="folders of `twin make`")
    accuracy.add_argument("--methods", default=",".join(METHODS), help=f"which of {','.join(METHODS)} (default all)")
    scaling = kinds.add_parser("scaling", help="time against vehicles (Fig. 7) and pictures a vehicle (Fig. 8)")
    scaling.add_argument("sets", nargs=1, type=Path, metavar="SET", help="a folder of `twin make`")
    scaling.add_argument("--vehicles", default="1,2,4,8,16,32,64,96", help="numbers of vehicles (default %(default)s)")
    scaling.add_argument("--images", default="42,85,170,339", help="pictures a vehicle (default %(default)s)")
    scaling.add_argument("--refine", default="swarm", help="which refiner (default %(default)s)")
    for sub in (accuracy, scaling):
        sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for results; maps are removed")
        sub.add_argument("--workers", type=int, metavar="N", help="processes at once (default: one for each core)")
        sub.add_argument("--keep", action="store_true", help="keep the maps")
        sub.add_argument("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Measure."""
    from orthoswarm.workers import single_threaded

    single_threaded()
    from orthoswarm.errors import InputError

    for folder in args.sets:
        if not (folder / "photos").is_dir() or not (folder / "basemap.tif").exists():
            raise InputError(f"{folder} is no set with photos and basemap.tif; make one with `orthoswarm twin make`")
    args.out.mkdir(parents=True, exist_ok=True)
    result = _accuracy(args) if args.kind == "accuracy" else _scaling(args)
    (args.out / f"{args.kind}.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    text = accuracy_table(result) if args.kind == "accuracy" else scaling_table(result)
    (args.out / f"{args.kind}.md").write_text(text, encoding="utf-8")
    if args.kind == "scaling":
        plot_scaling(result, args.out)
    print(json.dumps(result) if args.json else text)
    return 0 if any("error" not in row for row in result["rows"]) else 1


# -- accuracy -----------------------------------------------------------------------------------------------------


def _accuracy(args: argparse.Namespace) -> dict[str, Any]:
    from orthoswarm.errors import InputError

    methods = [m.strip() for m in args.methods.split(",") if m.strip()]
    if not methods or set(methods) - set(METHODS):
        raise InputError(f"--methods takes some of {', '.join(METHODS)}; give them with commas between")
    rows = []
    for folder in args.sets:
        if not (folder / "truth" / "reference.tif").exists():
            raise InputError(f"{folder} has no truth/reference.tif; make the set with `orthoswarm twin make`")
        for method in methods:
            kept = args.out / f"{folder.absolute().name}-{method}.json"
            if not kept.exists():
                print(f"{folder.name}: {method}", file=sys.stderr, flush=True)
                row = measure(folder, method, args.out / "map", args.workers, args.keep)
                kept.write_text(json.dumps(row, indent=1), encoding="utf-8")
            rows.append(json.loads(kept.read_text(encoding="utf-8")))
    return {"machine": machine(), "rows": rows}


def measure(folder: Path, method: str, out: Path, workers: int | None, keep: bool) -> dict[str, Any]:
    """One set mapped by one method and compared with the truth; a failure is a row with its message."""
    from gcs_plugin.commands.evaluate import evaluate_ortho, evaluate_poses
    from orthoswarm.errors import OrthoSwarmError

    name = folder.absolute().name
    out = out.with_name(f"map-{name}-{method}")
    row: dict[str, Any] = {"set": name, "method": method}
    try:
        if method == "truth":
            row |= true_orthoimage(folder, out)
            product = out / "orthoimage.tif"
        else:
            how = ["--until", "realtime"] if method == "nothing" else ["--refine", method]
            row |= _cost(_mosaic([folder / "photos"], folder / "basemap.tif", out, how, workers))
            product = out / ("realtime.tif" if method == "nothing" else "orthoimage.tif")
        truth = folder / "truth"
        mask = truth / "ground_mask.tif"
        row |= evaluate_ortho(product, truth / "reference.tif", mask if mask.exists() else None).figures()
        if method != "truth":
            row["poses"] = evaluate_poses(out / "frames.jsonl", truth / "frames.csv").figures()
    except OrthoSwarmError as error:
        row["error"] = str(error)
    if not keep:
        shutil.rmtree(out, ignore_errors=True)
    return row


def true_orthoimage(folder: Path, out: Path) -> dict[str, Any]:
    """Render a set from its true cameras over its true ground: the ceiling of the measure. Gives the time."""
    from time import perf_counter, process_time

    import numpy as np
    import rasterio

    import telemetry
    from gcs_plugin.commands.evaluate import read_truth
    from orthoswarm.errors import InputError
    from orthoswarm.export.cog import write_cog
    from orthoswarm.extent import drawn_window, placed_bounds
    from orthoswarm.geo import GroundGrid
    from orthoswarm.mosaic.canvas import Canvas
    from orthoswarm.mosaic.footprint import default_gsd
    from orthoswarm.mosaic.render import render
    from orthoswarm.placement import PlacedFrame, Terrain

    wall, cpu = perf_counter(), process_time()
    true = read_truth(folder / "truth" / "frames.csv")
    frames = [f for f in telemetry.load([folder / "photos"]).frames if f.image in true]
    if not frames:
        raise InputError(f"no photo of {folder} stands in its truth/frames.csv; make the set again")
    placed = [PlacedFrame(f, true[f.image][2], "fine", 0.0) for f in frames]
    with rasterio.open(folder / "truth" / "dtm.tif") as dtm:
        step = max(1, round(4.0 / dtm.transform.a))
        size = (dtm.height // step, dtm.width // step)
        z = dtm.read(1, out_shape=size, resampling=rasterio.enums.Resampling.average)[::-1].astype(np.float32)
        pitch = (dtm.bounds.right - dtm.bounds.left) / size[1]
        terrain = Terrain(dtm.bounds.left + pitch / 2, dtm.bounds.bottom + pitch / 2, pitch, np.ascontiguousarray(z))
    out.mkdir(parents=True, exist_ok=True)
    low, high = float(terrain.z.min()), float(terrain.z.max())
    gsd = default_gsd([p.camera for p in placed])
    grid = GroundGrid.around(true[frames[0].image][1], placed_bounds(placed, low, high), gsd)
    with Canvas.create(out / "canvas", grid, plane="frame") as canvas:
        render(placed, terrain, canvas)
        write_cog(canvas, out / "orthoimage.tif", window=drawn_window(canvas))
    return {"wall_s": perf_counter() - wall, "cpu_s": process_time() - cpu, "frames": len(placed)}


def accuracy_table(result: dict[str, Any]) -> str:
    """The result as a Markdown table."""
    names = {"nothing": "do nothing", "paper": "paper", "swarm": "swarm", "truth": "true poses"}
    lines = [
        f"Machine: {result['machine']}.",
        "",
        "| set | method | map median m | map 95 % m | not found | picture centres median / 95 % m "
        "| worst FoV error deg | CPU s | wall s | memory MB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        start = f"| {row['set']} | {names[row['method']]} |"
        if "error" in row:
            lines.append(f"{start} failed: {row['error']} | | | | | | | |")
            continue
        poses = row.get("poses") or {}
        fov = poses.get("fov_error_deg") or {}
        centres = " / ".join(_text(poses.get(f"center_ground_{k}_m"), 2) for k in ("median", "p95")) if poses else "-"
        cells = [
            _text(row["median_m"], 3),
            _text(row["p95_m"], 3),
            f"{row['unmatched_share']:.1%}",
            centres,
            _text(max(map(abs, fov.values())) if fov else None, 2),
            *(_text(row.get(k), 0) for k in ("cpu_s", "wall_s", "peak_rss_mb")),
        ]
        lines.append(f"{start} {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


# -- scaling ------------------------------------------------------------------------------------------------------


def _scaling(args: argparse.Namespace) -> dict[str, Any]:
    folder = args.sets[0]
    vehicles = sorted(p for p in (folder / "photos").iterdir() if p.is_dir())
    most = min(len(sorted(v.iterdir())) for v in vehicles) if vehicles else 0
    counts = sorted({n for n in _numbers(args.vehicles, "--vehicles") if n <= len(vehicles)})
    images = sorted({n for n in _numbers(args.images, "--images") if n <= most})
    runs = [("vehicles", n, most) for n in counts]
    runs += [("images", max(counts, default=1), n) for n in images]
    rows = []
    for kind, count, each in runs:
        kept = args.out / f"{folder.absolute().name}-{args.refine}-{count}x{each}.json"
        if not kept.exists():
            print(f"{count} vehicles, {each} pictures each", file=sys.stderr, flush=True)
            report = _subset(folder, vehicles[:count], each, args)
            kept.write_text(json.dumps(_cost(report)), encoding="utf-8")
        row = {"kind": kind, "vehicles": count, "images": each}
        rows.append(row | json.loads(kept.read_text(encoding="utf-8")))
    return {"machine": machine(), "refine": args.refine, "rows": rows}


def _subset(folder: Path, vehicles: list[Path], each: int, args: argparse.Namespace) -> dict[str, Any]:
    """Map the first pictures of some vehicles."""
    photos, out = args.out / "photos", args.out / "map"
    shutil.rmtree(photos, ignore_errors=True)
    for vehicle in vehicles:
        (photos / vehicle.name).mkdir(parents=True)
        for picture in sorted(vehicle.iterdir())[:each]:
            target = photos / vehicle.name / picture.name
            try:
                os.link(picture, target)
            except OSError:  # another file system
                shutil.copyfile(picture, target)
    report = _mosaic([photos], folder / "basemap.tif", out, ["--refine", args.refine], args.workers)
    shutil.rmtree(photos, ignore_errors=True)
    if not args.keep:
        shutil.rmtree(out, ignore_errors=True)
    return report


def scaling_table(result: dict[str, Any]) -> str:
    """The result as a Markdown table."""
    lines = [
        f"Machine: {result['machine']}. Refiner: {result['refine']}.",
        "",
        "| vehicles | pictures each | wall s | CPU s | CPU ms a picture | memory MB |",
        "|---|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        each = 1000 * row["cpu_s"] / max(row["frames"], 1)
        lines.append(
            f"| {row['vehicles']} | {row['images']} | {row['wall_s']:.1f} | {row['cpu_s']:.1f} | {each:.1f} "
            f"| {row['peak_rss_mb']:.0f} |"
        )
    return "\n".join(lines) + "\n"


def plot_scaling(result: dict[str, Any], out: Path) -> None:
    """Fig. 7 (time against vehicles) and Fig. 8 (time against pictures a vehicle), stages stacked."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    for kind, name, label in (("vehicles", "fig7.png", "vehicles"), ("images", "fig8.png", "pictures a vehicle")):
        rows = [r for r in result["rows"] if r["kind"] == kind]
        if not rows:
            continue
        figure, axes = pyplot.subplots(figsize=(7, 4.5), layout="constrained")
        x = [r[kind] for r in rows]
        stages = list(dict.fromkeys(s for r in rows for s in r["stages"]))
        axes.stackplot(x, [[r["stages"].get(s, 0.0) for r in rows] for s in stages], labels=stages, alpha=0.8)
        axes.plot(x, [r["wall_s"] for r in rows], "k.-", label="wall time")
        axes.set(xlabel=label, ylabel="CPU seconds by stage, wall seconds")
        axes.set_ylim(bottom=0)
        axes.legend(loc="upper left", fontsize=8)
        figure.savefig(out / name, dpi=110)
        pyplot.close(figure)


# -- helpers ------------------------------------------------------------------------------------------------------


def _mosaic(inputs: list[Path], basemap: Path, out: Path, how: list[str], workers: int | None) -> dict[str, Any]:
    """The report of a `mosaic` run in a process of its own."""
    from orthoswarm.errors import OrthoSwarmError

    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "gcs_plugin.cli", "mosaic", *map(str, inputs), "--basemap", str(basemap)]
    command += ["--out", str(out), "--json", *how, *(["--workers", str(workers)] if workers else [])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [
            line for line in done.stderr.splitlines() if line.startswith("orthoswarm:")
        ] or done.stderr.splitlines()
        raise OrthoSwarmError((lines or ["it ended without a message"])[-1].removeprefix("orthoswarm: "))
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def _cost(report: dict[str, Any]) -> dict[str, Any]:
    """What a run cost, from its report; stages of one name before the colon are added."""
    stages: dict[str, float] = {}
    for stage in report["stages"]:
        name = stage["name"].split(":")[0]
        stages[name] = stages.get(name, 0.0) + stage["cpu_s"]
    keys = ("wall_s", "cpu_s", "peak_rss_mb")
    return {k: report[k] for k in keys} | {"frames": report["frames"]["used"], "stages": stages}


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _numbers(text: str, flag: str) -> list[int]:
    from orthoswarm.errors import InputError

    try:
        numbers = [int(part) for part in text.split(",") if part.strip()]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < 1:
        raise InputError(f"{flag} {text} is no list of numbers; give for example 1,2,4")
    return numbers


def machine() -> str:
    """The machine in words: cores that may be used, processor, GPU."""
    import platform

    from orthoswarm.workers import cores

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    gpu = "an NVIDIA GPU" if shutil.which("nvidia-smi") else "no GPU"
    return f"{cores()} cores of {model}, {gpu}"

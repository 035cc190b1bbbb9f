"""Cost by number of vehicles (the paper's Fig. 7) and by pictures per vehicle (Fig. 8), each from separate runs."""

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gcs_plugin.bench.benchmark_runs import cost, link_photos, machine, mosaic, pictures, read_result, write_result
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.errors import InputError

FLAT = 0.2
"""Cost per picture counts as constant if it differs by at most this share from that of the smallest block."""
_SMALLEST_BLOCK = 1000  # pictures


def run_scaling(
    folder: Path,
    counts: Sequence[int],
    images: Sequence[int],
    *,
    refine: str,
    out: Path,
    workers: int | None,
    maps: bool,
) -> dict[str, Any]:
    """Map the first vehicles of a set, then the first pictures of all of them; each run's report.json is stored.

    Vehicles with fewer pictures than the largest number of the set are left out (a set that is still being made).

    Args:
        folder: the set. counts: numbers of vehicles; numbers above that of the set are left out.
        images: pictures per vehicle, for the runs with the largest number of vehicles. refine: the refiner.
        out: folder of results; existing ones are not computed again. workers: processes at once.
        maps: whether to keep the maps.

    Raises:
        InputError: if the set has no vehicles, or none of the numbers fits.
    """
    vehicles = {p: pictures(p) for p in sorted((folder / "photos").iterdir()) if p.is_dir()}
    most = max((len(v) for v in vehicles.values()), default=0)
    complete = [photos for photos in vehicles.values() if photos and len(photos) == most]
    if len(complete) < len(vehicles):
        print(f"{len(vehicles) - len(complete)} vehicles with fewer than {most} photos are left out", file=sys.stderr)
    there = [n for n in sorted(set(counts)) if n <= len(complete)]
    if not there:
        raise InputError(f"{folder} has {len(complete)} vehicles; give smaller numbers to --vehicles")
    each = [n for n in sorted(set(images)) if n <= most]
    runs = [("vehicles", n, most) for n in there] + [("images", there[-1], n) for n in each]
    rows = []
    for kind, count, number in runs:
        name = f"{folder.absolute().name}-{refine}-{count}x{number}"
        report = read_result(out / f"{name}.json")
        if report is None:
            print(f"{count} vehicles, {number} pictures each", file=sys.stderr, flush=True)
            photos = [photo for vehicle in complete[:count] for photo in vehicle[:number]]
            report = _run(folder, photos, name, refine=refine, out=out, workers=workers, maps=maps)
        rows.append({"kind": kind, "vehicles": count, "images": number} | cost(report))
    return {"machine": machine(), "set": folder.absolute().name, "refine": refine, "rows": rows}


def _run(
    folder: Path, photos: list[Path], name: str, *, refine: str, out: Path, workers: int | None, maps: bool
) -> dict[str, Any]:
    """Map some photos of a set, and store the report."""
    subset, product = out / "photos", out / f"map-{name}"
    link_photos(photos, folder / "photos", subset)
    report = mosaic(subset, folder / "basemap.tif", product, ["--refine", refine], workers)
    write_result(out / f"{name}.json", report)
    shutil.rmtree(subset, ignore_errors=True)
    if not maps:
        shutil.rmtree(product, ignore_errors=True)
    return report


def growth(result: dict[str, Any]) -> dict[str, Any]:
    """Change of CPU time and memory per picture, relative to the smallest block of at least 1,000 pictures.

    Returns:
        `base`: number of pictures of that block. `points`: for it and each larger run over vehicles `frames`, and `cpu`
        and `memory` per picture relative to the block's. `cpu_spread`: the largest deviation of `cpu` from 1. `flat`:
        whether that is at most 20 % and memory per picture grows by at most 20 %. Empty with fewer than two such runs.
    """
    rows = [r for r in result["rows"] if r["kind"] == "vehicles" and r["frames"] >= _SMALLEST_BLOCK]
    rows.sort(key=lambda r: int(r["frames"]))
    if len(rows) < 2:
        return {}
    first = rows[0]

    def relative(row: dict[str, Any], key: str) -> float:
        return float(row[key] / row["frames"] / (first[key] / first["frames"]))

    points = [{"frames": r["frames"], "cpu": relative(r, "cpu_s"), "memory": relative(r, "peak_rss_mb")} for r in rows]
    spread = max(abs(p["cpu"] - 1.0) for p in points)
    flat = spread <= FLAT and all(p["memory"] <= 1.0 + FLAT for p in points)
    return {"base": first["frames"], "points": points, "cpu_spread": spread, "flat": flat}


def scaling_table(result: dict[str, Any]) -> str:
    """The result as a Markdown table, with a sentence about growth."""
    lines = [
        f"Machine: {result['machine']}. Set: {result['set']}. Refiner: {result['refine']}.",
        "",
        "| vehicles | pictures each | pictures | wall s | CPU s | CPU ms a picture | memory MB |",
        "|---" * 7 + "|",
    ]
    for row in result["rows"]:
        each = 1000 * row["cpu_s"] / max(row["frames"], 1)
        lines.append(
            f"| {row['vehicles']} | {row['images']} | {row['frames']} | {row['wall_s']:.1f} | {row['cpu_s']:.1f} "
            f"| {each:.1f} | {row['peak_rss_mb']:.0f} |"
        )
    grown = growth(result)
    if grown:
        last = grown["points"][-1]
        lines += [
            "",
            f"From {grown['base']:,} to {last['frames']:,} pictures the CPU time per picture stays within "
            f"{grown['cpu_spread']:.0%} of the first, memory per picture goes to {last['memory']:.0%} of it: "
            f"{'flat' if grown['flat'] else 'NOT flat'} within {FLAT:.0%}.",
        ]
    return "\n".join(lines) + "\n"


# -- plots --------------------------------------------------------------------------------------------------------


def plot_scaling(result: dict[str, Any], out: Path) -> list[Path]:
    """Draw fig7.png (time by vehicles), fig8.png (by pictures per vehicle), growth.png; returns the files drawn."""
    import matplotlib

    matplotlib.use("Agg")
    out.mkdir(parents=True, exist_ok=True)
    drawn = []
    for kind, name, axis in (
        ("vehicles", "fig7.png", f"vehicles, {_fixed(result, 'vehicles', 'images')} pictures each"),
        ("images", "fig8.png", f"pictures a vehicle, {_fixed(result, 'images', 'vehicles')} vehicles"),
    ):
        rows = [r for r in result["rows"] if r["kind"] == kind]
        if rows:
            drawn.append(_plot_times(rows, kind, axis, result, out / name))
    if growth(result):
        drawn.append(_plot_growth(result, out / "growth.png"))
    return drawn


def _fixed(result: dict[str, Any], kind: str, key: str) -> int:
    return int(next((r[key] for r in result["rows"] if r["kind"] == kind), 0))


def _plot_times(rows: list[dict[str, Any]], kind: str, axis: str, result: dict[str, Any], path: Path) -> Path:
    """CPU seconds stacked by stage, and the wall time with all cores in use."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7.5, 4.5), layout="constrained")
    x = [r[kind] for r in rows]
    stages = list(dict.fromkeys(s for r in rows for s in r["stages"]))
    axes.stackplot(x, [[r["stages"].get(s, 0.0) for r in rows] for s in stages], labels=stages, alpha=0.75)
    axes.plot(x, [r["wall_s"] for r in rows], "k.-", label="time on the clock")
    axes.set(xlabel=axis, ylabel="seconds (areas: CPU time by stage)", xlim=(0, None), ylim=(0, None))
    axes.set_title(f"{result['refine']}, {result['machine']}", fontsize=9)
    axes.grid(alpha=0.3)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="upper left", fontsize=8)  # in the order of the stack
    return _saved(figure, path)


def _plot_growth(result: dict[str, Any], path: Path) -> Path:
    """CPU milliseconds per picture and memory by number of pictures; the band is +-20 % around the smallest block."""
    from matplotlib import pyplot

    rows = sorted((r for r in result["rows"] if r["kind"] == "vehicles"), key=lambda r: int(r["frames"]))
    x, each = [r["frames"] for r in rows], [1000 * r["cpu_s"] / r["frames"] for r in rows]
    first = next(r for r in rows if r["frames"] >= _SMALLEST_BLOCK)
    level = 1000 * first["cpu_s"] / first["frames"]
    figure, (upper, lower) = pyplot.subplots(2, 1, figsize=(7.5, 6), sharex=True, layout="constrained")
    upper.axhspan(
        (1 - FLAT) * level, (1 + FLAT) * level, color="0.9", label=f"{first['frames']:,} pictures +-{FLAT:.0%}"
    )
    upper.plot(x, each, "o-", label="CPU time")
    upper.plot(x, [1000 * r["wall_s"] / r["frames"] for r in rows], "k.-", label="time on the clock")
    upper.set(ylabel="ms a picture", ylim=(0, None))
    upper.set_title(f"{result['refine']}, {result['machine']}", fontsize=9)
    lower.plot(x, [r["peak_rss_mb"] for r in rows], "o-", label="peak memory, all processes")
    lower.set(ylabel="MB", xlabel="pictures", ylim=(0, None), xscale="log")
    for axes in (upper, lower):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    lower.set_xticks(x, [f"{n:,}" for n in x], rotation=45, fontsize=8)
    lower.minorticks_off()
    return _saved(figure, path)


def _saved(figure: Any, path: Path) -> Path:
    from matplotlib import pyplot

    with atomic_write(path) as part:
        figure.savefig(part, dpi=110, format="png")
    pyplot.close(figure)
    return path

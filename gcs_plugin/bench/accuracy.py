"""Accuracy and cost on data sets with truth: recorded poses, the paper's refiner, the default refiner, true poses."""

import shutil
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gcs_plugin.bench.benchmark_runs import (
    check_set,
    cost,
    described,
    label,
    machine,
    mosaic,
    read_result,
    share,
    text,
    write_result,
)
from gcs_plugin.daemon.store.frame_rows import arrived_frames
from gcs_plugin.daemon.store.journal import Journal
from orthoswarm.evaluation.true_cameras import read_truth
from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import PlacedFrame, Terrain

METHODS = ("nothing", "paper", "swarm", "truth")
NAMES = {"nothing": "do nothing", "paper": "paper", "swarm": "swarm", "truth": "true poses"}


def run_accuracy(
    sets: Sequence[Path], methods: Sequence[str], out: Path, workers: int | None, keep_maps: bool
) -> dict[str, Any]:
    """Measure every method on every set; results that exist in `out` are not measured again.

    Raises:
        InputError: if a folder is not a data set with truth.
    """
    for folder in sets:
        check_set(folder, truth=True)
    rows = []
    for folder in sets:
        for method in methods:
            path = out / f"{folder.absolute().name}-{method}.json"
            row = read_result(path)
            if row is None:
                print(f"{folder.name}: {method}", file=sys.stderr, flush=True)
                row = measure(folder, method, out / "map", workers, keep_maps)
                write_result(path, row)
            rows.append(described(folder) | row)
    return {"machine": machine(), "rows": rows}


def measure(folder: Path, method: str, out: Path, workers: int | None, keep_map: bool) -> dict[str, Any]:
    """Map one set by one method and compare it with the truth; a failure gives a row with its message."""
    from orthoswarm.evaluation.true_cameras import evaluate_poses
    from orthoswarm.model.errors import OrthoSwarmError

    out = out.with_name(f"map-{folder.absolute().name}-{method}")
    row: dict[str, Any] = described(folder) | {"method": method}
    try:
        if method == "truth":
            row |= true_orthoimage(folder, out)
            product = out / "orthoimage.tif"
        else:
            how = ["--until", "realtime"] if method == "nothing" else ["--refine", method]
            row |= cost(mosaic(folder / "photos", folder / "basemap.tif", out, how, workers))
            product = out / ("realtime.tif" if method == "nothing" else "orthoimage.tif")
        row |= judged(product, folder)
        if method != "truth":
            row["poses"] = evaluate_poses(out / "frames.jsonl", folder / "truth" / "frames.csv").figures()
    except OrthoSwarmError as error:
        row["error"] = str(error)
    if not keep_map:
        shutil.rmtree(out, ignore_errors=True)
    return row


def judged(product: Path, folder: Path) -> dict[str, Any]:
    """The figures of `orthoswarm evaluate` for a map of a set."""
    from orthoswarm.evaluation.orthoimage import evaluate_ortho

    truth = folder / "truth"
    mask = truth / "ground_mask.tif"
    return evaluate_ortho(product, truth / "reference.tif", mask if mask.exists() else None).figures()


def true_orthoimage(folder: Path, out: Path, photos: Path | None = None) -> dict[str, Any]:
    """Render a set from its true cameras and true terrain: the best result that can be measured. Returns the times.

    Args:
        folder: the set. out: where orthoimage.tif goes.
        photos: some of its photos in the same sub-folders, None for all.
    """
    from time import perf_counter, process_time

    import telemetry
    from orthoswarm.evaluation.true_cameras import read_truth
    from orthoswarm.model.errors import InputError
    from orthoswarm.model.placement import PlacedFrame

    wall, cpu = perf_counter(), process_time()
    true = read_truth(folder / "truth" / "frames.csv")
    frames = [f for f in telemetry.load([photos or folder / "photos"]).frames if f.image in true]
    if not frames:
        raise InputError(f"truth/frames.csv lists no photo of {folder}; make the set again")
    placed = [PlacedFrame(f, true[f.image][2], "fine", 0.0) for f in frames]
    paste(placed, _true_ground(folder), true[frames[0].image][1], out)
    return {"wall_s": perf_counter() - wall, "cpu_s": process_time() - cpu, "frames": len(placed)}


def _true_ground(folder: Path) -> Any:
    import numpy as np
    import rasterio

    from orthoswarm.model.placement import Terrain

    with rasterio.open(folder / "truth" / "dtm.tif") as dtm:
        step = max(1, round(4.0 / dtm.transform.a))
        size = (dtm.height // step, dtm.width // step)
        z = dtm.read(1, out_shape=size, resampling=rasterio.enums.Resampling.average)[::-1].astype(np.float32)
        pitch = (dtm.bounds.right - dtm.bounds.left) / size[1]
        return Terrain(dtm.bounds.left + pitch / 2, dtm.bounds.bottom + pitch / 2, pitch, np.ascontiguousarray(z))


def accuracy_table(result: dict[str, Any]) -> str:
    """The result as a Markdown table; the share within 1 m is also given relative to that of the true poses."""
    lines = [
        f"Machine: {result['machine']}.",
        "",
        "| set | method | map median m | map 95 % m | not found | within 1 m | of what true poses give "
        "| picture centres median / 95 % m | error within 1 / 2 sigma | worst FoV error deg "
        "| CPU s | wall s | memory MB |",
        "|---" * 13 + "|",
    ]
    within = {r["set"]: r.get("share_within_1m") for r in result["rows"] if r["method"] == "truth"}
    for row in result["rows"]:
        start = f"| {label(row)} | {NAMES[row['method']]} |"
        if "error" in row:
            lines.append(f"{start} failed: {row['error']} |" + " |" * 10)
            continue
        best, poses = within.get(row["set"]), row.get("poses") or {}
        fov = [abs(v) for v in (poses.get("fov_error_deg") or {}).values() if v is not None]
        centres = " / ".join(text(poses.get(f"center_ground_{k}_m"), 2) for k in ("median", "p95")) if poses else "-"
        within_sigma = " / ".join(share(poses.get(f"sigma_within_{k}"), 0) for k in (1, 2)) if poses else "-"
        cells = [
            text(row["median_m"], 3),
            text(row["p95_m"], 3),
            share(row["unmatched_share"]),
            share(row["share_within_1m"]),
            share(row["share_within_1m"] / best if best else None),
            centres,
            within_sigma,
            text(max(fov, default=None), 2),
            *(text(row.get(k), 0) for k in ("cpu_s", "wall_s", "peak_rss_mb")),
        ]
        lines.append(f"{start} {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def paste(placed: Sequence[PlacedFrame], terrain: Terrain, epsg: int, out: Path) -> Path:
    """Render frames over a terrain into OUT/orthoimage.tif (COG, RGBA) and return its path.

    Args:
        placed: frames with cameras in the grid `epsg`; heights share the datum of the terrain.
        terrain: ground heights.
        epsg: the UTM zone.
        out: a folder, created if missing.
    """
    from orthoswarm.canvas.canvas import Canvas
    from orthoswarm.export.cog import write_cog
    from orthoswarm.model.geo import GroundGrid
    from orthoswarm.mosaic.extent import drawn_window, placed_bounds
    from orthoswarm.mosaic.footprint import default_gsd
    from orthoswarm.mosaic.renderer import render

    out.mkdir(parents=True, exist_ok=True)
    low, high = float(terrain.z.min()), float(terrain.z.max())
    gsd = default_gsd([p.camera for p in placed], low)
    grid = GroundGrid.around(epsg, placed_bounds(placed, low, high), gsd)
    with Canvas.create(out / "canvas", grid, plane="frame") as canvas:
        render(placed, terrain, canvas)
        write_cog(canvas, out / "orthoimage.tif", window=drawn_window(canvas))
    return out / "orthoimage.tif"


def live_errors(workspace: Path, truth: Path) -> dict[str, dict[str, float]]:
    """Errors of pictures' middles on the ground when they were drawn first, by what placed them.

    Args:
        workspace: of a daemon, running or not. truth: a twin's frames.csv, whose images have the names that were sent.

    Returns:
        `placed_by` (receiver, map, and all) -> `pictures`, `median_m`, `p95_m`, `sigma_1` and `sigma_2` (percent of the
        axes' errors within one and two `sigma_m`), `after_median_s`, `after_p95_s` (arrival to the map).

    Raises:
        InputError: there is no journal, or no picture of it has a true camera.
    """
    if not (workspace / "journal.db").exists():
        raise InputError(f"{workspace} is not the workspace of a daemon; give the folder of `serve --workspace`")
    journal, true = Journal(workspace / "journal.db"), read_truth(truth)
    try:
        rows = [row for row in arrived_frames(journal) if row.placed and row.image in true]
    finally:
        journal.close()
    found: dict[str, list[list[float]]] = defaultdict(list)
    for row in rows:
        first, camera = row.placed.get("first", row.placed), true[row.image][2]
        middle = np.array([0.5 * (camera.lens.width - 1), 0.5 * (camera.lens.height - 1)])
        east, north, w = np.array(first["pose"]["homography"]) @ [*middle, 1.0]
        off = np.array([east / w, north / w]) - camera.to_ground(middle, first["pose"]["ground_z_m"])
        for by in (first["placed_by"], "all"):
            found[by].append([*off, first["sigma_m"], first["placed_after_s"]])
    if not found:
        raise InputError(
            f"no picture in {workspace} is named in {truth}; give the truth of the pictures that were sent"
        )
    return {by: _summary(np.array(values)) for by, values in sorted(found.items())}


def _summary(table: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, float]:
    """Of rows east, north, sigma, seconds."""
    length, axes, sigma, after = np.hypot(*table[:, :2].T), np.abs(table[:, :2]), table[:, 2:3], table[:, 3]
    figures = {
        "median_m": np.median(length), "p95_m": np.percentile(length, 95), "sigma_1": 100 * (axes < sigma).mean(),
        "sigma_2": 100 * (axes < 2 * sigma).mean(), "after_median_s": np.median(after),
        "after_p95_s": np.percentile(after, 95),
    }  # fmt: skip
    return {"pictures": len(table)} | {name: round(float(value), 3) for name, value in figures.items()}

"""Where a daemon drew pictures first, against their true cameras."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from gcs_plugin.daemon.store.frame_rows import arrived_frames
from gcs_plugin.daemon.store.journal import Journal
from orthoswarm.evaluation.true_cameras import read_truth
from orthoswarm.model.errors import InputError


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

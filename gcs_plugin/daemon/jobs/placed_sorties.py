"""Placed sorties in the journal: their frames, their solutions, and their neighbours."""

import json
import sqlite3
import time
from collections.abc import Iterable
from typing import Any

from gcs_plugin.daemon.intake.posted_pose import frame_of_row
from gcs_plugin.daemon.jobs.job_queue import Job
from gcs_plugin.daemon.jobs.solution_file import Bytes, thumbnail_of
from gcs_plugin.daemon.jobs.worker_tasks import SortieResult
from gcs_plugin.daemon.store.journal import Change, Journal, packed
from gcs_plugin.daemon.store.picture_store import PictureStore
from orthoswarm.export.product_files import finite
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame


def sortie_frames(
    journal: Journal, store: PictureStore, vehicle: str, sortie: int | None
) -> tuple[list[Frame], dict[str, Bytes]]:
    """A sortie's frames in order of time, without rejected ones, and image -> thumbnail of the drawn ones.

    Raises:
        OrthoSwarmError: there are none.
    """
    rows = journal.rows(
        "SELECT frames.*, thumbnails.rgb FROM frames LEFT JOIN thumbnails USING (seq)"
        " WHERE vehicle = ? AND sortie = ? AND reason IS NULL ORDER BY time, seq",
        (packed(vehicle), sortie),
    )
    if not rows:
        raise OrthoSwarmError(f"{vehicle} has no pictures that could be drawn; check its camera and its poses")
    frames = [frame_of_row(row, store) for row in rows]
    small = {f.image: thumbnail_of(row["rgb"]) for f, row in zip(frames, rows, strict=True) if row["rgb"] is not None}
    return frames, small


def detail_of(solved: SortieResult, legs: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """The journal's details of a placed sortie, as JSON values."""
    return {
        "bounds": solved.bounds,
        "legs": [leg | {key: finite(leg[key]) for key in ("confidence", "sigma_m")} for leg in legs],
        "fov_deg": finite(solved.fov_deg), "fov_sigma_deg": finite(solved.fov_sigma_deg),
        "warnings": solved.warnings, "cpu_s": solved.cpu_s, "wall_s": solved.wall_s,
    }  # fmt: skip


def solution_row(journal: Journal, job: Job) -> Any:
    """The solution's row of a job's sortie, None if it was not refined."""
    return journal.one(
        "SELECT * FROM solutions WHERE vehicle = ? AND sortie = ?", (packed(str(job.vehicle)), job.sortie)
    )


def others_near(journal: Journal, job: Job, box: BoundingBox, reach_m: float) -> list[Any]:
    """Rows of the refined sorties (except the job's own) whose ground is within a distance of a box."""
    mine = (packed(str(job.vehicle)), job.sortie)
    return [
        row
        for row in journal.rows("SELECT * FROM solutions ORDER BY vehicle, sortie")
        if (row["vehicle"], row["sortie"]) != mine
        and BoundingBox(*json.loads(row["detail"])["bounds"]).gap_m(box) < reach_m
    ]


def refined_change(
    job: Job, solved: SortieResult, rejected: dict[str, str], name: str, detail: dict[str, Any]
) -> Change:
    """The change that records a refinement: the stages of its frames, its solution, and its job as done.

    Args:
        job: whose vehicle and sortie it is. solved: with stages and sigmas of the new frames.
        rejected: image -> why it could not be drawn. name: of the solution file. detail: stored with it.
    """
    vehicle = packed(str(job.vehicle))
    dropped = {**solved.dropped, **rejected}
    placed = [
        (stage, finite(sigma), vehicle, job.sortie, packed(image))
        for image, (stage, sigma) in solved.stages.items()
        if image not in dropped
    ]
    lost = [(why, vehicle, job.sortie, packed(image)) for image, why in dropped.items()]

    def change(db: sqlite3.Connection) -> None:
        db.executemany("UPDATE frames SET stage = ?, sigma = ? WHERE vehicle = ? AND sortie = ? AND image = ?", placed)
        db.executemany(
            "UPDATE frames SET stage = 'rejected', reason = ? WHERE vehicle = ? AND sortie = ? AND image = ?", lost
        )
        db.execute(
            "INSERT OR REPLACE INTO solutions VALUES (?, ?, ?, ?)", (vehicle, job.sortie, name, json.dumps(detail))
        )
        # The job's result is recorded in the same change, so that it is not repeated if the daemon ends now.
        db.execute("UPDATE jobs SET state = 'done', progress = 1, ended = ? WHERE id = ?", (time.time(), job.id))

    return change

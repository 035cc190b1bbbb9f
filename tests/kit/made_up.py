"""A daemon in this process, and the flights over a made-up ground that it is fed with."""

import time

import numpy as np

from gcs_plugin.daemon.intake.posted_pose import parse_pose
from gcs_plugin.daemon.store.job_rows import new_job
from gcs_plugin.daemon.store.journal import packed
from orthoswarm.model.geo import LocalGrid

GRID = LocalGrid(32631)
OFF_M = np.array([2.0, -2.2])
LIMIT_S = 400.0


def post(daemon, frames, off_m=OFF_M):
    """Send frames with records that are off."""
    for frame in frames:
        lat, lon = (float(v) for v in GRID.to_geographic(truth(frame) + off_m))
        pose = {
            "vehicle": frame.vehicle, "image": frame.image, "time": frame.time_s, "lat_deg": lat, "lon_deg": lon,
            "height_m": frame.fix.height_m, "yaw_deg": float(np.degrees(frame.fix.yaw_rad)), "pitch_deg": -90.0,
            "roll_deg": 0.0,
        }  # fmt: skip
        daemon.intake.add(parse_pose(pose), frame.path.read_bytes())


def truth(frame):
    return GRID.to_grid(frame.fix.lat_deg, frame.fix.lon_deg)


def complete(daemon, vehicle="v1"):
    """What the flock writes when a vehicle reports that its mission is complete."""

    def change(db):
        db.execute("INSERT INTO completions (vehicle, sortie, detail) VALUES (?, 1, '{}')", (packed(vehicle),))
        new_job("refine", vehicle, 1, {"trigger": "complete"})(db)

    daemon.journal.write(change)
    daemon.jobs.wake()


def after_job(daemon, count, *, last="refine"):
    """Wait until so many refinements, and a job of the last kind, have ended, and nothing is left to do.

    What a job leads to is asked for after its end: between the two nothing is open. Gives the refinements.
    """
    end = time.monotonic() + LIMIT_S
    while True:
        everything = daemon.jobs.all()
        jobs = [job for job in everything if job.kind == "refine"]
        there = len(jobs) >= count and any(job.kind == last for job in everything)
        if there and not daemon.jobs.open() and all(job.ended for job in everything):
            return jobs
        assert time.monotonic() < end, [job.document() for job in daemon.jobs.all()]
        time.sleep(0.05)

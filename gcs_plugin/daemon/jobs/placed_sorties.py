"""Placed sorties for the jobs that place them: their frames, what the journal keeps of them, and their neighbours."""

from collections.abc import Iterable, Mapping

from gcs_plugin.daemon.intake.posted_pose import frame_of_row
from gcs_plugin.daemon.jobs.solution_file import Bytes, thumbnail_of
from gcs_plugin.daemon.jobs.worker_tasks import SortieResult
from gcs_plugin.daemon.store.frame_rows import Whose, sortie_frames
from gcs_plugin.daemon.store.job_rows import Job, job_done
from gcs_plugin.daemon.store.journal import Change, Journal, all_changes
from gcs_plugin.daemon.store.picture_store import PictureStore
from gcs_plugin.daemon.store.sortie_rows import LegRow, PlacedSortie, SortieDetail, placed_sorties, sortie_refined
from orthoswarm.export.json_values import finite
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from telemetry.samples.held_fixes import measured_frames


def frames_of(journal: Journal, store: PictureStore, job: Job) -> tuple[list[Frame], dict[str, Bytes]]:
    """The frames of a job's sortie in order of time, without rejected ones, and image -> thumbnail of the drawn ones.

    Raises:
        OrthoSwarmError: there are none.
    """
    rows = sortie_frames(journal, str(job.vehicle), job.sortie)
    if not rows:
        raise OrthoSwarmError(f"{job.vehicle} has no pictures that could be drawn; check its camera and its poses")
    small = {row.image: thumbnail_of(row.thumbnail) for row in rows if row.thumbnail is not None}
    return measured_frames([frame_of_row(row, store) for row in rows]), small


def detail_of(solved: SortieResult, legs: Iterable[LegRow]) -> SortieDetail:
    """The journal's details of a placed sortie."""
    return {
        "bounds": solved.bounds,
        "legs": [leg | LegRow(confidence=finite(leg["confidence"]), sigma_m=finite(leg["sigma_m"])) for leg in legs],
        "fov_deg": finite(solved.fov_deg), "fov_sigma_deg": finite(solved.fov_sigma_deg),
        "warnings": solved.warnings, "cpu_s": solved.cpu_s, "wall_s": solved.wall_s,
    }  # fmt: skip


def others_near(journal: Journal, whose: Whose, box: BoundingBox, reach_m: float) -> list[PlacedSortie]:
    """The refined sorties (except that one) whose ground is within a distance of a box."""
    return [
        row for row in placed_sorties(journal, "solutions") if row.whose != whose and row.bounds.gap_m(box) < reach_m
    ]


def refined_change(
    job: Job, solved: SortieResult, rejected: Mapping[str, str], name: str, detail: SortieDetail
) -> Change:
    """The change that records a refinement: the stages of its frames, its solution, and its job as done.

    Args:
        job: whose sortie it is. solved: with stages and sigmas of the new frames.
        rejected: image -> why it could not be drawn. name: of the solution file. detail: stored with it.
    """
    stands = sortie_refined(PlacedSortie(*job.whose, name, detail), solved.stages, {**solved.dropped, **rejected})
    return all_changes(stands, job_done(job.id))

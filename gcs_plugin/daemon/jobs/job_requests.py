"""Which jobs are asked for when something has happened: a leg is over, a mission complete, a refinement done."""

from typing import Final

from gcs_plugin.daemon.jobs.job_queue import Jobs
from gcs_plugin.daemon.jobs.leg_watch import LegWatch
from gcs_plugin.daemon.jobs.workspace_products import FORMATS, PRODUCTS
from gcs_plugin.daemon.store.daemon_events import (
    CardRead,
    JobEnded,
    LegsOver,
    MissionNoted,
    RefinementBegins,
    VehicleSilent,
)
from gcs_plugin.daemon.store.frame_rows import Whose, late_frames, photographed_sorties, unplaced_frames
from gcs_plugin.daemon.store.job_rows import Job, refinement_is_open
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.sortie_rows import complete_sorties, is_complete, present_sortie
from orthoswarm.model.errors import InputError

_REPLACED: Final = "dropped: the vehicle's refinement takes its place"
_COMPLETE: Final = "dropped: the vehicle is complete, its refinement takes its place"
_WATCHED_AGAIN: Final = 2000  # pictures of the last daemon


class JobRequests:
    """Asks for jobs."""

    def __init__(self, journal: Journal, jobs: Jobs, *, coarse: bool) -> None:
        self._journal, self._jobs, self._coarse = journal, jobs, coarse

    def refine(self, vehicle: str | None = None) -> list[Job]:
        """Queue the refinement of a vehicle's last sortie, or of all sorties that have pictures.

        Raises:
            InputError: the vehicle has sent no picture.
        """
        wanted = photographed_sorties(self._journal)
        if vehicle is not None:
            wanted = [whose for whose in wanted if whose[0] == vehicle][-1:]
            if not wanted:
                raise InputError(f"vehicle {vehicle} has sent no picture; see /api/vehicles")
        return [self._jobs.add("refine", *whose) for whose in wanted]

    def export(self, formats: list[str]) -> Job:
        """Queue an export.

        Raises:
            InputError: an unknown format.
        """
        unknown = [name for name in formats if name not in FORMATS]
        if unknown or not formats:
            raise InputError(f"there is no format {unknown or 'given'}; choose from: {', '.join(FORMATS)}")
        return self._jobs.add("export", formats=list(dict.fromkeys(formats)))

    def continue_last(self, watch: LegWatch) -> None:
        """Ask for what the last daemon left undone, and have its unplaced pictures watched."""
        for whose in complete_sorties(self._journal):
            self._refine_late(whose)
        for row in unplaced_frames(self._journal, _WATCHED_AGAIN):
            time_s = row.arrived_s if row.time_s is None else row.time_s
            watch.add(row.vehicle, row.sortie, time_s, row.pose["lat_deg"], row.pose["lon_deg"])

    # -- what has happened ----------------------------------------------------------------------------------------

    def legs_over(self, event: LegsOver) -> None:
        """Queue the coarse map of a sortie that is still flown."""
        if self._coarse and not is_complete(self._journal, (event.vehicle, event.sortie)):
            self._jobs.add("coarse", event.vehicle, event.sortie, **({"over": True} if event.silent else {}))

    def vehicle_silent(self, event: VehicleSilent) -> None:
        """Have pictures placed that came after their vehicle's refinement, over a slow link."""
        self._refine_late((event.vehicle, event.sortie))

    def card_read(self, event: CardRead) -> None:
        """Have the sortie refined with the pictures of a card that was read after landing."""
        self._refine_late((event.vehicle, present_sortie(self._journal, event.vehicle)))

    def _refine_late(self, whose: Whose) -> None:
        if not refinement_is_open(self._journal, whose, "queued") and late_frames(self._journal, *whose):
            self._jobs.add("refine", *whose, trigger="late")

    def mission_noted(self, event: MissionNoted) -> None:
        """Begin the refinement that a completion has queued; the vehicle's coarse maps are not needed any more."""
        if event.kind == "complete":
            self._jobs.drop("coarse", event.vehicle, _COMPLETE)
        self._jobs.wake()

    def refinement_begins(self, event: RefinementBegins) -> None:
        """Drop the vehicle's coarse maps."""
        self._jobs.drop("coarse", event.vehicle, _REPLACED)

    def job_ended(self, event: JobEnded) -> None:
        """Export the products again once nothing is left to refine."""
        job = event.job
        if job.kind == "refine":
            self._jobs.wake()
        elif job.kind not in ("together", "tones", "redraw") and (job.kind != "coarse" or "after" not in job.detail):
            return
        if not self._jobs.open("refine", "together", "tones", "coarse", "redraw"):
            self._jobs.add("export", formats=list(PRODUCTS), after="all")

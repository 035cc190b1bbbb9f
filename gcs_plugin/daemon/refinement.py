"""Refinement of one vehicle's sortie: gather its frames, solve and draw in worker processes, publish at once."""

import json
import sqlite3
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.crew import Crew
from gcs_plugin.daemon.drawing import Drawer, frame_of_row
from gcs_plugin.daemon.jobs import Job, new_job
from gcs_plugin.daemon.journal import Change, Journal, late_frames, packed
from gcs_plugin.daemon.kept import Bytes, thumbnail_of
from gcs_plugin.daemon.layers import Bounds, new_name
from gcs_plugin.daemon.press import Press
from gcs_plugin.daemon.store import PictureStore
from gcs_plugin.daemon.work import Solved, SolveTask, joined, lay_beside, near, solve
from orthoswarm.errors import OrthoSwarmError
from orthoswarm.frame import Frame
from orthoswarm.products import finite

_REACH_M: Final = 400.0
_DRAWN_S: Final = 3.0
_QUIET_S: Final = 0.7
_MOST_QUIET_S: Final = 3.0
_LATE_S: Final = 15.0
_AGAIN: Final = 10
"""So many pictures that came late have their vehicle refined again; fewer are laid beside its refined ones."""
Tell = Callable[[float, str], None]


@dataclass(slots=True)
class Refinement:
    """Does the jobs `refine`.

    Attributes:
        journal, store, press: what there is. crew: where the work runs. drawer: of the real-time layer.
        basemap: the map, or None. on_published: called with layer and job when pixels have changed.
        make_way: called with vehicle and layer before the work begins, and before the layer is needed.
    """

    journal: Journal
    store: PictureStore
    press: Press
    crew: Crew
    drawer: Drawer
    basemap: Path | None
    on_published: Callable[[str, Job], None] = lambda layer, job: None
    make_way: Callable[[str, str | None], None] = lambda vehicle, layer: None
    stopped: Callable[[], bool] = lambda: False

    def refine(self, job: Job, tell: Tell) -> Change:
        """The handler of `refine`."""
        vehicle = str(job.vehicle)
        began = time.monotonic()
        tell(0.02, "waiting for the last pictures")
        self.make_way(vehicle, None)
        if job.detail.get("trigger") == "complete":
            self._wait_quiet(job)
        self.drawer.wait_drawn(vehicle, job.sortie, _DRAWN_S)
        if job.detail.get("trigger") == "late" and not late_frames(self.journal, vehicle, job.sortie, job.id):
            return _nothing_came(job)
        job.detail["refine_started_s"] = time.time()
        area = self.press.area()
        frames, thumbnails = sortie_frames(self.journal, self.store, vehicle, job.sortie)
        before = self._beside(job, len(frames))
        tell(0.05, f"refining {len(frames)} pictures" if before is None else "laying late pictures beside the others")
        target = self.press.kept / f"{new_name('solution')}.pickle"
        task = SolveTask(
            frames, area.epsg, area.origin, self.basemap, thumbnails, self._neighbours(job, near(frames, area.epsg)),
            target, None if before is None else self.press.kept / before["path"],
        )  # fmt: skip
        solved = self.crew.run(solve if before is None else lay_beside, task)
        if before is not None:
            job.detail["beside"] = len(solved.stages)
            if not solved.stages and not solved.dropped:
                target.unlink(missing_ok=True)
                return _nothing_came(job)
        job.detail |= {
            "frames": len(frames), "solve_cpu_s": round(solved.cpu_s, 3), "solve_s": round(solved.wall_s, 3),
            "warnings": solved.warnings,
        }  # fmt: skip
        self._show(job, tell, target, solved, before)
        job.detail["seconds"] = round(time.monotonic() - began, 3)
        return lambda db: None

    def _show(self, job: Job, tell: Tell, target: Path, solved: Solved, before: Any) -> None:
        """Draw and publish what was solved."""
        vehicle, layer = str(job.vehicle), "fine" if self.basemap is not None else "coarse"
        job.detail["layer"] = layer
        self.make_way(vehicle, layer)
        with self.press.turn(layer):
            tell(0.7, "drawing")
            shown = self.press.shown(layer).get((packed(vehicle), job.sortie or 0))
            changed = solved.changed
            if before is None and shown is not None:  # it leaves where it was
                changed = joined([changed, shown[1]])
            job.detail["version_before"], job.detail["version"] = self.press.print(
                layer, self.crew, (vehicle, job.sortie), target, changed,
                lambda rejected: self._publish(job, layer, target, solved, rejected, before),
            )  # fmt: skip
        job.detail["published_s"] = time.time()
        self.on_published(layer, job)

    # -- the parts ------------------------------------------------------------------------------------------------

    def _wait_quiet(self, job: Job) -> None:
        """Pictures that were on their way when the vehicle completed still belong to its sortie.

        They are thought to be all there when none has come for longer than they came apart before.
        """
        end = time.monotonic() + _LATE_S
        while time.monotonic() < end and not self.stopped():
            rows = self.journal.rows(
                "SELECT arrived FROM frames WHERE vehicle = ? AND sortie = ? ORDER BY seq DESC LIMIT 8",
                (packed(str(job.vehicle)), job.sortie),
            )
            came = [float(row["arrived"]) for row in rows]
            apart = max((a - b for a, b in pairwise(came)), default=0.0)
            if came and time.time() - came[0] > min(max(_QUIET_S, apart), _MOST_QUIET_S):
                return
            time.sleep(0.05)

    def _beside(self, job: Job, count: int) -> Any:
        """The kept refinement beside which late pictures are laid; None if all are to be refined."""
        if job.detail.get("trigger") != "late":
            return None
        row = self.journal.one(
            "SELECT * FROM solutions WHERE vehicle = ? AND sortie = ?", (packed(str(job.vehicle)), job.sortie)
        )
        refined = None if row is None else json.loads(row["detail"]).get("refined")
        return row if refined is not None and count - refined < _AGAIN else None

    def _neighbours(self, job: Job, box: Bounds) -> list[Path]:
        """Solutions of others whose ground comes near."""
        mine = (packed(str(job.vehicle)), job.sortie)
        return [
            self.press.kept / row["path"]
            for row in self.journal.rows("SELECT * FROM solutions")
            if (row["vehicle"], row["sortie"]) != mine and apart_m(json.loads(row["detail"])["bounds"], box) < _REACH_M
        ]

    def _publish(
        self, job: Job, layer: str, target: Path, solved: Solved, rejected: dict[str, str], before: Any
    ) -> Change:
        vehicle = packed(str(job.vehicle))
        dropped = {**solved.dropped, **rejected}
        placed = [
            (stage, finite(sigma), vehicle, job.sortie, packed(image))
            for image, (stage, sigma) in solved.stages.items()
            if image not in dropped
        ]
        lost = [(why, vehicle, job.sortie, packed(image)) for image, why in dropped.items()]
        if before is None:
            detail = json.dumps(detail_of(solved, solved.legs) | {"layer": layer, "refined": len(placed)})
        else:
            detail = json.dumps(json.loads(before["detail"]) | {"bounds": solved.bounds})
        old = self.journal.one("SELECT path FROM solutions WHERE vehicle=? AND sortie=?", (vehicle, job.sortie))
        then = None
        if self.basemap is not None:  # the coarse layer shows all of the sortie, too
            then = new_job("coarse", str(job.vehicle), job.sortie, {"after": "refine"})

        def change(db: sqlite3.Connection) -> None:
            db.executemany(
                "UPDATE frames SET stage = ?, sigma = ? WHERE vehicle = ? AND sortie = ? AND image = ?", placed
            )
            db.executemany(
                "UPDATE frames SET stage = 'rejected', reason = ? WHERE vehicle = ? AND sortie = ? AND image = ?", lost
            )
            db.execute(
                "INSERT OR REPLACE INTO solutions VALUES (?, ?, ?, ?)", (vehicle, job.sortie, target.name, detail)
            )
            # The job's result stands with this, so that it is not done again if the daemon ends right now.
            db.execute("UPDATE jobs SET state = 'done', progress = 1, ended = ? WHERE id = ?", (time.time(), job.id))
            if then is not None:
                then(db)

        if old is not None:
            self.press.retire(self.press.kept / old["path"])
        return change


def _nothing_came(job: Job) -> Change:
    job.detail["note"] = "nothing came late"
    return lambda db: None


def sortie_frames(
    journal: Journal, store: PictureStore, vehicle: str, sortie: int | None
) -> tuple[list[Frame], dict[str, Bytes]]:
    """A sortie's frames in order of time that were not rejected, and image -> thumbnail of those that were drawn.

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


def detail_of(solved: Solved, legs: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """What the journal keeps of a placed sortie, as JSON values."""
    return {
        "bounds": solved.bounds,
        "legs": [leg | {key: finite(leg[key]) for key in ("confidence", "sigma_m")} for leg in legs],
        "fov_deg": finite(solved.fov_deg), "fov_sigma_deg": finite(solved.fov_sigma_deg),
        "warnings": solved.warnings, "cpu_s": solved.cpu_s, "wall_s": solved.wall_s,
    }  # fmt: skip


def apart_m(one: Bounds, other: Bounds) -> float:
    """How far two boxes lie apart along an axis; negative where they overlap."""
    return max(one[0] - other[2], other[0] - one[2], one[1] - other[3], other[1] - one[3])

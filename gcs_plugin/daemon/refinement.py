"""Refinement of one vehicle's sortie: gather its frames, solve and draw in worker processes, publish at once.

Until the last step nothing of what the map shows changes; the last step is one transaction of the journal, which names
the layer's new generation, the frames' stages and the job's end.
"""

import json
import sqlite3
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.crew import Crew
from gcs_plugin.daemon.drawing import Drawer, frame_of_row
from gcs_plugin.daemon.jobs import Job
from gcs_plugin.daemon.journal import Change, Journal, fact_change, packed
from gcs_plugin.daemon.layers import Area, Layer, new_name
from gcs_plugin.daemon.store import PictureStore
from gcs_plugin.daemon.work import DrawTask, Solved, SolveTask, draw, solve
from orthoswarm.errors import OrthoSwarmError
from orthoswarm.frame import Frame
from orthoswarm.mosaic.canvas import Canvas
from orthoswarm.products import finite

_REACH_M: Final = 400.0
_IDLE_S: Final = 30.0
_QUIET_S: Final = 0.7
_LATE_S: Final = 6.0
Tell = Callable[[float, str], None]


@dataclass(slots=True)
class Refinement:
    """Does the jobs `refine` and `coarse`.

    Attributes:
        journal, store: what there is. layers: by name. folder: of the layers' canvases. solutions: folder for pickles.
        crew: where the work runs. drawer: knows the area. basemap: the map, or None.
        on_published: called with layer, vehicle, sortie and version when pixels have changed.
    """

    journal: Journal
    store: PictureStore
    layers: dict[str, Layer]
    folder: Path
    solutions: Path
    crew: Crew
    drawer: Drawer
    basemap: Path | None
    on_published: Callable[[str, Job], None] = lambda layer, job: None
    _one_drawing: threading.Lock = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Make what is missing, remove what a killed daemon left half made, and open what it had published."""
        self._one_drawing = threading.Lock()
        self.solutions.mkdir(parents=True, exist_ok=True)
        for name in ("coarse", "fine"):
            generation = self.journal.fact(name)
            if generation is not None and (self.folder / generation / "canvas.json").exists():
                self.layers[name].replace(Canvas.open(self.folder / generation))
        self.sweep()

    def sweep(self) -> None:
        """Remove canvases and pickles that nothing names."""
        import shutil

        named = {self.journal.fact(name) for name in ("realtime", "coarse", "fine")}
        for path in self.folder.iterdir():
            if path.name not in named:
                shutil.rmtree(path, ignore_errors=True)
        known = {row["path"] for row in self.journal.rows("SELECT path FROM solutions")}
        for path in self.solutions.iterdir():
            if path.name not in known:
                path.unlink(missing_ok=True)

    def refine(self, job: Job, tell: Tell) -> Change:
        """The handler of `refine`."""
        assert job.vehicle is not None
        began = time.monotonic()
        tell(0.02, "waiting for the last pictures")
        if job.detail.get("trigger") == "complete":
            self._wait_quiet(job)
        self.drawer.wait_idle(_IDLE_S)
        job.detail["refine_started_s"] = time.time()
        area, frames = self._area(), self._frames(job)
        tell(0.05, f"refining {len(frames)} pictures")
        target = self.solutions / f"{new_name('solution')}.pickle"
        task = SolveTask(
            frames, area.epsg, area.origin, self.basemap, self._neighbours(job, frames), target
        )  # fmt: skip
        solved = self.crew.run(solve, task)
        with self._one_drawing:
            tell(0.7, "drawing")
            layer = "fine" if self.basemap is not None else "coarse"
            name = new_name(layer)
            rejected = self.crew.run(draw, self._draw_task(job, layer, name, target, frames))
            job.detail |= {
                "layer": layer, "frames": len(frames), "solve_cpu_s": round(solved.cpu_s, 3),
                "solve_s": round(solved.wall_s, 3), "seconds": round(time.monotonic() - began, 3),
            }  # fmt: skip
            version_before = self.layers[layer].version
            change = self._publish(job, layer, name, target, solved, rejected)
            self.journal.write(change)  # here, so that the next drawing begins from it
            self.layers[layer].replace(Canvas.open(self.folder / name))
        job.detail |= {
            "version_before": version_before, "version": self.layers[layer].version, "published_s": time.time(),
        }  # fmt: skip
        self.on_published(layer, job)
        return lambda db: None

    # -- the parts ------------------------------------------------------------------------------------------------

    def _wait_quiet(self, job: Job) -> None:
        """Pictures that were on their way when the vehicle completed still belong to its sortie."""
        end, last, since = time.monotonic() + _LATE_S, -1, time.monotonic()
        while time.monotonic() < end:
            row = self.journal.one(
                "SELECT COUNT(*) AS n FROM frames WHERE vehicle = ? AND sortie = ?",
                (packed(str(job.vehicle)), job.sortie),
            )
            count = 0 if row is None else int(row["n"])
            if count != last:
                last, since = count, time.monotonic()
            elif time.monotonic() - since > _QUIET_S:
                return
            time.sleep(0.1)

    def _area(self) -> Area:
        if self.drawer.area is None:
            raise OrthoSwarmError("there is no map yet; wait for pictures")
        return self.drawer.area

    def _frames(self, job: Job) -> list[Frame]:
        rows = self.journal.rows(
            "SELECT * FROM frames WHERE vehicle = ? AND sortie = ? AND reason IS NULL ORDER BY time, seq",
            (packed(str(job.vehicle)), job.sortie),
        )
        if not rows:
            raise OrthoSwarmError(f"{job.vehicle} has no pictures that could be drawn; check its camera and its poses")
        return [frame_of_row(row, self.store) for row in rows]

    def _neighbours(self, job: Job, frames: list[Frame]) -> list[Path]:
        """Solutions of others whose ground comes near."""
        from gcs_plugin.daemon.work import _near

        box = _near(frames, self._area().epsg)
        near = []
        for row in self.journal.rows("SELECT * FROM solutions"):
            if (row["vehicle"], row["sortie"]) == (packed(str(job.vehicle)), job.sortie):
                continue
            w, s, e, n = json.loads(row["detail"])["bounds"]
            apart = max(w - box[2], box[0] - e, s - box[3], box[1] - n)
            if apart < _REACH_M:
                near.append(self.solutions / row["path"])
        return near

    def _draw_task(self, job: Job, layer: str, name: str, target: Path, frames: list[Frame]) -> DrawTask:
        mine = (packed(str(job.vehicle)), job.sortie)
        others, before = [], None
        for row in self.journal.rows("SELECT * FROM solutions ORDER BY vehicle, sortie"):
            detail = json.loads(row["detail"])
            if (row["vehicle"], row["sortie"]) == mine:
                w, s, e, n = detail["bounds"]
                before = (w, s, e, n)
            elif detail["layer"] == layer:
                others.append(self.solutions / row["path"])
        canvas = self.layers[layer].canvas
        old = None if canvas is None else canvas.path
        return DrawTask(old, self.folder / name, self._area().grid, [*others, target], target, before)

    def _publish(
        self, job: Job, layer: str, name: str, target: Path, solved: Solved, rejected: dict[str, str]
    ) -> Change:
        vehicle = packed(str(job.vehicle))
        dropped = {**solved.dropped, **rejected}
        placed = [
            (stage, finite(sigma), vehicle, job.sortie, packed(image))
            for image, (stage, sigma) in solved.stages.items()
            if image not in dropped
        ]
        lost = [(why, vehicle, job.sortie, packed(image)) for image, why in dropped.items()]
        detail = json.dumps(
            {
                "bounds": solved.bounds, "layer": layer, "legs": [_clean(leg) for leg in solved.legs],
                "fov_deg": finite(solved.fov_deg), "fov_sigma_deg": finite(solved.fov_sigma_deg),
                "warnings": solved.warnings, "cpu_s": solved.cpu_s, "wall_s": solved.wall_s,
            }
        )  # fmt: skip
        old = self.journal.one("SELECT path FROM solutions WHERE vehicle=? AND sortie=?", (vehicle, job.sortie))
        fact = fact_change(layer, name)

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
            fact(db)

        if old is not None:
            stale = self.solutions / old["path"]
            later = threading.Timer(60.0, stale.unlink, kwargs={"missing_ok": True})  # others may be reading it
            later.daemon = True
            later.start()
        return change


def _clean(leg: dict[str, Any]) -> dict[str, Any]:
    return leg | {"confidence": finite(leg["confidence"]), "sigma_m": finite(leg["sigma_m"])}

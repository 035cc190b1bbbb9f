"""Publishing: the next generation of a refined layer is drawn separately and then replaces the present one at once.

Until the last step the map does not change; the last step is one transaction of the journal, which names
the layer's new generation and all facts that change with it.
"""

import logging
import shutil
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from gcs_plugin.daemon.intake.posted_pose import frame_of_row
from gcs_plugin.daemon.jobs.job_queue import RunningJob
from gcs_plugin.daemon.jobs.solution_file import Bytes, is_readable, thumbnail_of
from gcs_plugin.daemon.jobs.worker_tasks import DrawTask, SortieResult, SortieTask, draw
from gcs_plugin.daemon.layers.layers import MapArea, MapLayer, new_name
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.store import sortie_rows
from gcs_plugin.daemon.store.daemon_events import Events, LayerPublished
from gcs_plugin.daemon.store.frame_rows import Whose, sortie_frames
from gcs_plugin.daemon.store.job_rows import Job, job_done
from gcs_plugin.daemon.store.journal import Change, Journal, all_changes, fact_change, no_change
from gcs_plugin.daemon.store.picture_store import PictureStore
from gcs_plugin.daemon.store.sortie_rows import REFINED, LegRow, PlacedSortie, SortieDetail, Table
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.export.json_values import finite
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from telemetry.samples.held_fixes import measured_frames

_TABLES: tuple[Table, ...] = ("solutions", "coarse")
_log = logging.getLogger(__name__)


class Publisher:
    """Draws generations of the layers `coarse` and `fine`, one of each at a time.

    Attributes:
        folder: of the layers' canvases. solutions: folder of the solution files.
        basemap: the map, or None. refined: the layer of refinements: fine with a map, coarse without.
        lost: layers whose pixels cannot be trusted and are to be drawn again (see `draw_again`).
        outdated: vehicle and sortie of those that were refined by another version of the program, and are to be
            refined again from their pictures.
    """

    def __init__(
        self, journal: Journal, layers: dict[str, MapLayer], workspace: Path, *, drawer: Drawer, events: Events,
        basemap: Path | None, device: str = "auto", trusted: bool,
    ) -> None:  # fmt: skip
        """Remove unfinished files of a killed daemon, and open what it had published.

        Args:
            workspace: its folder. device: where networks run.
            trusted: False after a power cut: canvases are not synced, for speed.
        """
        self.journal, self.layers, self._drawer, self._events = journal, layers, drawer, events
        self.basemap, self._device, self.refined = basemap, device, "fine" if basemap is not None else "coarse"
        self.folder, self.solutions = workspace / "layers", workspace / "solutions"
        self._turns = {name: threading.Lock() for name in REFINED}
        self.solutions.mkdir(parents=True, exist_ok=True)
        self.outdated = self._forget_outdated()
        begun = journal.fact("lost") or []
        self.lost = [name for name in REFINED if not self._opened(name, trusted) or name in begun]
        journal.write(fact_change("lost", self.lost))
        self.sweep()

    def _opened(self, layer: str, trusted: bool) -> bool:
        """Open the published generation of a layer; False if it cannot be trusted and is dropped."""
        generation = self.journal.fact(layer)
        if generation is None:
            return not sortie_rows.shown_sorties(self.journal, layer)
        try:
            if not trusted:
                raise OrthoSwarmError("its last pixels may have been lost in the power cut")
            self.layers[layer].replace(Canvas.open(self.folder / generation))
        except (OrthoSwarmError, OSError) as error:
            _log.warning("the layer %s is drawn again: %s", layer, error)
            self.journal.write(fact_change(layer, None))
            return False
        return True

    def _forget_outdated(self) -> list[Whose]:
        """Forget solutions that cannot be read, with their layers; returns the refined sorties among them."""
        outdated = {
            table: [
                row
                for row in sortie_rows.placed_sorties(self.journal, table)
                if not is_readable(self.solutions / row.path)
            ]
            for table in _TABLES
        }
        if not any(outdated.values()):
            return []
        self.journal.write(sortie_rows.placements_forgotten(outdated))
        refined = [row.whose for row in outdated["solutions"]]
        _log.warning(
            "the refined map was made by another version of the program; %d sorties are refined again", len(refined)
        )
        return refined

    def draw_again(self, run: RunningJob) -> Change:
        """The handler of `redraw`: draws the lost layers from the solution files."""
        todo = [(layer, row.whose) for layer in self.lost for row in sortie_rows.shown_sorties(self.journal, layer)]
        for n, (layer, whose) in enumerate(todo):
            with self.turn(layer) as turn:
                row = self.shown(layer, whose)
                if row is None:
                    continue  # refined, or drawn again, meanwhile
                run.report(n / len(todo), f"drawing {row.vehicle} on {layer}")
                turn.draw(run, whose, self.solutions / row.path, row.bounds)
                turn.publish(no_change)
        return fact_change("lost", [])

    def sweep(self) -> None:
        """Remove canvases and solution files that are not referenced."""
        named = {self.journal.fact(name) for name in ("realtime", *REFINED)}
        for path in self.folder.iterdir():
            if path.name not in named:
                shutil.rmtree(path, ignore_errors=True)
        known = self._named()
        for path in self.solutions.iterdir():
            if path.name not in known:
                path.unlink(missing_ok=True)

    def _named(self) -> set[str]:
        """The solution files that the journal names."""
        return {path for table in _TABLES for path in sortie_rows.solution_paths(self.journal, table).values()}

    def area(self) -> MapArea:
        """The map's area; raises OrthoSwarmError: there is no map yet."""
        if self._drawer.area is None:
            raise OrthoSwarmError("there is no map yet; wait for pictures")
        return self._drawer.area

    def task(self, target: Path, **more: Any) -> SortieTask:
        """A worker's task on the map's area; `more`: further values of a SortieTask."""
        area = self.area()
        return SortieTask(
            epsg=area.epsg, origin=area.origin, target=target, basemap=self.basemap, device=self._device, **more
        )

    @contextmanager
    def new_solution(self, kind: str = "solution") -> Iterator[Path]:
        """The path of a new solution file, which is removed in the end unless the journal names it."""
        target = self.solutions / f"{new_name(kind)}.pickle"
        try:
            yield target
        finally:
            if target.name not in self._named():
                target.unlink(missing_ok=True)

    @contextmanager
    def turn(self, layer: str) -> Iterator["LayerTurn"]:
        """Wait for exclusive use of a layer."""
        with self._turns[layer]:
            turn = LayerTurn(self, layer)
            try:
                yield turn
            finally:
                if not turn.published:
                    shutil.rmtree(turn.folder, ignore_errors=True)

    def refined_near(self, whose: Whose, box: BoundingBox, reach_m: float = 0.0) -> dict[Whose, Path]:
        """The solution files of the refined sorties (except that one) whose ground is within a distance of a box."""
        return {
            row.whose: self.solutions / row.path
            for row in sortie_rows.placed_sorties(self.journal, "solutions")
            if row.whose != whose and row.bounds.gap_m(box) < reach_m
        }

    def tell(self, layer: str, job: Job) -> None:
        """Tell that a job has changed pixels of a layer."""
        version = self.layers[layer].version
        self._events.publish(LayerPublished(layer, version, job.vehicle, job.sortie))

    def shown(self, layer: str, whose: Whose) -> PlacedSortie | None:
        """A sortie on a layer, None if it is not there."""
        return next((row for row in sortie_rows.shown_sorties(self.journal, layer) if row.whose == whose), None)

    def retire(self, row: PlacedSortie | None) -> None:
        """Remove the solution file of what was replaced, later, as others may be reading it."""
        if row is not None:
            path = self.solutions / row.path
            later = threading.Timer(60.0, path.unlink, kwargs={"missing_ok": True})
            later.daemon = True
            later.start()


class LayerTurn:
    """The exclusive use of a layer, in which one sortie is drawn into its next generation, and this published.

    Attributes:
        folder: of the next generation's canvas; removed unless it was `published`.
    """

    def __init__(self, publisher: Publisher, layer: str) -> None:
        self._publisher, self._layer, self._name = publisher, layer, new_name(layer)
        self.folder, self.published = publisher.folder / self._name, False

    def draw(self, run: RunningJob, whose: Whose, target: Path, changed: BoundingBox) -> dict[str, str]:
        """Draw a placed sortie; returns image -> why it could not be drawn.

        Args:
            target: its solution file. changed: ground whose pixels change.

        Raises:
            OrthoSwarmError: the disk is full, or the work was stopped.
        """
        publisher = self._publisher
        others = [
            publisher.solutions / row.path
            for row in sortie_rows.shown_sorties(publisher.journal, self._layer)
            if row.whose != whose and row.bounds.overlaps(changed)
        ]
        canvas = publisher.layers[self._layer].canvas
        task = DrawTask(
            old=None if canvas is None else canvas.path, new=self.folder, grid=publisher.area().grid,
            solutions=[*others, target], changed=target, bounds=changed,
        )  # fmt: skip
        return run.run(draw, task)

    def publish(self, change: Change) -> dict[str, int]:
        """Make what was drawn the layer, and a change of the journal with it; returns the versions before and now.

        Raises:
            OrthoSwarmError: the disk is full; nothing has changed.
        """
        publisher, layer = self._publisher, self._publisher.layers[self._layer]
        before = layer.version
        publisher.journal.write(all_changes(change, fact_change(self._layer, self._name)))
        self.published = True
        layer.replace(Canvas.open(self.folder))
        return {"version_before": before, "version": layer.version}


def frames_of(journal: Journal, store: PictureStore, job: Job) -> tuple[list[Frame], dict[str, Bytes]]:
    """The frames of a job's sortie in order of time, without rejected ones, and image -> thumbnail of the drawn ones.

    Raises:
        OrthoSwarmError: there are none.
    """
    rows = sortie_frames(journal, str(job.vehicle), job.sortie)
    if not rows:
        raise OrthoSwarmError(f"{job.vehicle} has no pictures that could be drawn; check its camera and its poses")
    small = {row.image: thumbnail_of(row.thumbnail) for row in rows if row.thumbnail is not None}
    told = [replace(row, pose={k: v for k, v in row.pose.items() if k != "held_m"}) for row in rows]
    return measured_frames([frame_of_row(row, store) for row in told]), small  # by fixes that came later, too


def detail_of(solved: SortieResult, legs: Iterable[LegRow]) -> SortieDetail:
    """The journal's details of a placed sortie."""
    return {
        "bounds": solved.bounds,
        "legs": [leg | LegRow(confidence=finite(leg["confidence"]), sigma_m=finite(leg["sigma_m"])) for leg in legs],
        "fov_deg": finite(solved.fov_deg), "fov_sigma_deg": finite(solved.fov_sigma_deg),
        "warnings": solved.warnings, "cpu_s": solved.cpu_s, "wall_s": solved.wall_s,
    }  # fmt: skip


def refined_change(
    job: Job, solved: SortieResult, rejected: Mapping[str, str], name: str, detail: SortieDetail
) -> Change:
    """The change that records a refinement: the stages of its frames, its solution, and its job as done.

    Args:
        job: whose sortie it is. solved: with stages and sigmas of the new frames.
        rejected: image -> why it could not be drawn. name: of the solution file. detail: stored with it.
    """
    stands = sortie_rows.sortie_refined(
        PlacedSortie(*job.whose, name, detail), solved.stages, {**solved.dropped, **rejected}
    )
    return all_changes(stands, job_done(job.id))

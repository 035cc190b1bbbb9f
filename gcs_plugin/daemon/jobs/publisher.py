"""Publishing: the next generation of a refined layer is drawn separately and then replaces the present one at once.

Until the last step the map does not change; the last step is one transaction of the journal, which names
the layer's new generation and all facts that change with it.
"""

import logging
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from gcs_plugin.daemon.intake.posted_pose import frame_of_row
from gcs_plugin.daemon.jobs.job_queue import ReportProgress
from gcs_plugin.daemon.jobs.solution_file import Bytes, is_readable, thumbnail_of
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import DrawTask, SortieResult, draw
from gcs_plugin.daemon.layers.layers import MapArea, MapLayer, new_name
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.store.daemon_events import Events, LayerPublished
from gcs_plugin.daemon.store.frame_rows import Whose, sortie_frames
from gcs_plugin.daemon.store.job_rows import Job, job_done
from gcs_plugin.daemon.store.journal import Change, Journal, all_changes, fact_change, no_change
from gcs_plugin.daemon.store.picture_store import PictureStore
from gcs_plugin.daemon.store.sortie_rows import (
    REFINED,
    LegRow,
    PlacedSortie,
    SortieDetail,
    Table,
    placed_sorties,
    placements_forgotten,
    shown_sorties,
    solution_paths,
    sortie_refined,
)
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
        lost: layers whose pixels cannot be trusted and are to be drawn again (see `draw_again`).
        outdated: vehicle and sortie of those that were refined by another version of the program, and are to be
            refined again from their pictures.
    """

    def __init__(
        self, journal: Journal, layers: dict[str, MapLayer], workspace: Path, *, drawer: Drawer, events: Events,
        workers: WorkerPool, trusted: bool,
    ) -> None:  # fmt: skip
        """Remove unfinished files of a killed daemon, and open what it had published.

        Args:
            workspace: its folder. workers: draw lost layers again.
            trusted: False after a power cut: canvases are not synced, for speed.
        """
        self.journal, self.layers, self._drawer, self._events, self._workers = journal, layers, drawer, events, workers
        self.folder, self.solutions = workspace / "layers", workspace / "solutions"
        self._turns = {name: threading.Lock() for name in REFINED}
        self.drawing: set[str] = set()
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
            return not shown_sorties(self.journal, layer)
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
            table: [row for row in placed_sorties(self.journal, table) if not is_readable(self.solutions / row.path)]
            for table in _TABLES
        }
        if not any(outdated.values()):
            return []
        self.journal.write(placements_forgotten(outdated))
        refined = [row.whose for row in outdated["solutions"]]
        _log.warning(
            "the refined map was made by another version of the program; %d sorties are refined again", len(refined)
        )
        return refined

    def draw_again(self, _: Job, report: ReportProgress) -> Change:
        """The handler of `redraw`: draws the lost layers from the solution files."""
        todo = [(layer, row.whose) for layer in self.lost for row in shown_sorties(self.journal, layer)]
        for n, (layer, whose) in enumerate(todo):
            with self.turn(layer):
                row = self.shown(layer, whose)
                if row is None:
                    continue  # refined, or drawn again, meanwhile
                report(n / len(todo), f"drawing {row.vehicle} on {layer}")
                target = self.solutions / row.path
                self.publish(layer, self._workers, whose, target=target, changed=row.bounds, change=_as_it_is)
        return fact_change("lost", [])

    def sweep(self) -> None:
        """Remove canvases and solution files that are not referenced."""
        named = {self.journal.fact(name) for name in ("realtime", *REFINED)}
        for path in self.folder.iterdir():
            if path.name not in named:
                shutil.rmtree(path, ignore_errors=True)
        known = {path for table in _TABLES for path in solution_paths(self.journal, table).values()}
        for path in self.solutions.iterdir():
            if path.name not in known:
                path.unlink(missing_ok=True)

    def area(self) -> MapArea:
        """The map's area.

        Raises:
            OrthoSwarmError: there is no map yet.
        """
        if self._drawer.area is None:
            raise OrthoSwarmError("there is no map yet; wait for pictures")
        return self._drawer.area

    @contextmanager
    def turn(self, layer: str) -> Iterator[None]:
        """Wait for exclusive use of a layer."""
        with self._turns[layer]:
            self.drawing.add(layer)
            try:
                yield
            finally:
                self.drawing.discard(layer)

    def publish(
        self,
        layer: str,
        workers: WorkerPool,
        whose: Whose,
        *,
        target: Path,
        changed: BoundingBox,
        change: Callable[[dict[str, str]], Change],
    ) -> tuple[int, int]:
        """Draw a placed sortie into the next generation of a layer and publish it; the layer's turn must be held.

        Args:
            layer: coarse or fine. workers: where the work runs.
            target: its solution file. changed: ground whose pixels change.
            change: returns the journal change, given image -> why it could not be drawn.

        Returns:
            The layer's version before and now.

        Raises:
            OrthoSwarmError: the disk is full, or the work was stopped; nothing has changed.
        """
        name = new_name(layer)
        try:
            rejected = workers.run(draw, self._task(layer, name, whose, target, changed))
            stands = all_changes(change(rejected), fact_change(layer, name))
            before = self.layers[layer].version
            self.journal.write(stands)  # here, so that the next drawing starts from it
        except BaseException:
            shutil.rmtree(self.folder / name, ignore_errors=True)
            raise
        self.layers[layer].replace(Canvas.open(self.folder / name))
        return before, self.layers[layer].version

    def tell(self, layer: str, job: Job) -> None:
        """Tell that a job has changed pixels of a layer."""
        version = self.layers[layer].version
        self._events.publish(LayerPublished(layer, version, job.vehicle, job.sortie))

    def shown(self, layer: str, whose: Whose) -> PlacedSortie | None:
        """A sortie on a layer, None if it is not there."""
        return next((row for row in shown_sorties(self.journal, layer) if row.whose == whose), None)

    def retire(self, path: Path) -> None:
        """Remove a solution file later, as others may be reading it."""
        later = threading.Timer(60.0, path.unlink, kwargs={"missing_ok": True})
        later.daemon = True
        later.start()

    def _task(self, layer: str, name: str, whose: Whose, target: Path, changed: BoundingBox) -> DrawTask:
        others = [
            self.solutions / row.path
            for row in shown_sorties(self.journal, layer)
            if row.whose != whose and row.bounds.overlaps(changed)
        ]
        canvas = self.layers[layer].canvas
        return DrawTask(
            old=None if canvas is None else canvas.path,
            new=self.folder / name,
            grid=self.area().grid,
            solutions=[*others, target],
            changed=target,
            bounds=changed,
        )


def _as_it_is(_: dict[str, str]) -> Change:
    return no_change


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

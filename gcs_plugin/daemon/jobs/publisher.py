"""Publishing: the next generation of a refined layer is drawn separately and then replaces the present one at once.

Until the last step the map does not change; the last step is one transaction of the journal, which names
the layer's new generation and all facts that change with it.
"""

import json
import logging
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gcs_plugin.daemon.jobs.solution_file import is_readable
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import DrawTask, draw
from gcs_plugin.daemon.layers.layers import Area, Layer, new_name
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.store.journal import Change, Journal, fact_change, packed, unpacked
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError

REFINED = ("coarse", "fine")
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
        self,
        journal: Journal,
        layers: dict[str, Layer],
        folder: Path,
        solutions: Path,
        drawer: Drawer,
        *,
        trusted: bool,
    ) -> None:
        """Remove unfinished files of a killed daemon, and open what it had published.

        Args:
            trusted: False after a power cut: canvases are not synced, for speed.
        """
        self.journal, self.layers, self.folder, self.solutions, self._drawer = (
            journal,
            layers,
            folder,
            solutions,
            drawer,
        )
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
            return not self.shown(layer)
        try:
            if not trusted:
                raise OrthoSwarmError("its last pixels may have been lost in the power cut")
            self.layers[layer].replace(Canvas.open(self.folder / generation))
        except (OrthoSwarmError, OSError) as error:
            _log.warning("the layer %s is drawn again: %s", layer, error)
            self.journal.write(fact_change(layer, None))
            return False
        return True

    def _forget_outdated(self) -> list[tuple[str, int]]:
        """Drop solution files that cannot be read, and the layers that show them.

        Returns the refined sorties among them.
        """
        outdated = {
            table: [row for row in self._rows(table) if not is_readable(self.solutions / row["path"])]
            for table in ("solutions", "coarse")
        }
        keys = [(row["vehicle"], row["sortie"]) for rows in outdated.values() for row in rows]
        if not keys:
            return []

        def change(db: sqlite3.Connection) -> None:
            for table, rows in outdated.items():
                names = [(row["vehicle"], row["sortie"]) for row in rows]
                db.executemany(f"DELETE FROM {table} WHERE vehicle = ? AND sortie = ?", names)
            db.executemany(
                "UPDATE frames SET stage = 'realtime' WHERE vehicle = ? AND sortie = ? AND stage IN ('coarse', 'fine')",
                keys,
            )
            for layer in REFINED:
                fact_change(layer, None)(db)

        self.journal.write(change)
        refined = [(unpacked(row["vehicle"]), int(row["sortie"])) for row in outdated["solutions"]]
        _log.warning(
            "the refined map was made by another version of the program; %d sorties are refined again", len(refined)
        )
        return refined

    def draw_again(self, workers: WorkerPool, report: Callable[[float, str], None]) -> Change:
        """Draw the lost layers from the solution files; returns the change that records it."""
        todo = [(layer, key) for layer in self.lost for key in self.shown(layer)]
        for n, (layer, (vehicle, sortie)) in enumerate(todo):
            with self.turn(layer):
                row = self.shown(layer).get((vehicle, sortie))
                if row is None:
                    continue  # refined, or drawn again, meanwhile
                report(n / len(todo), f"drawing {unpacked(vehicle)} on {layer}")
                whose = (unpacked(vehicle), sortie)
                self.publish(
                    layer, workers, whose, target=row[0], changed=row[1], change=lambda rejected: lambda db: None
                )
        return fact_change("lost", [])

    def sweep(self) -> None:
        """Remove canvases and solution files that are not referenced."""
        named = {self.journal.fact(name) for name in ("realtime", *REFINED)}
        for path in self.folder.iterdir():
            if path.name not in named:
                shutil.rmtree(path, ignore_errors=True)
        known = {row["path"] for table in ("solutions", "coarse") for row in self._rows(table)}
        for path in self.solutions.iterdir():
            if path.name not in known:
                path.unlink(missing_ok=True)

    def area(self) -> Area:
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
        sortie: tuple[str, int | None],
        *,
        target: Path,
        changed: BoundingBox,
        change: Callable[[dict[str, str]], Change],
    ) -> tuple[int, int]:
        """Draw a placed sortie into the next generation of a layer and publish it; the layer's turn must be held.

        Args:
            layer: coarse or fine. workers: where the work runs. sortie: vehicle and number.
            target: its solution file. changed: ground whose pixels change.
            change: returns the journal change, given image -> why it could not be drawn.

        Returns:
            The layer's version before and now.

        Raises:
            OrthoSwarmError: the disk is full, or the work was stopped; nothing has changed.
        """
        name = new_name(layer)
        try:
            rejected = workers.run(draw, self._task(layer, name, sortie, target, changed))
            fact, other = fact_change(layer, name), change(rejected)

            def both(db: sqlite3.Connection) -> None:
                other(db)
                fact(db)

            before = self.layers[layer].version
            self.journal.write(both)  # here, so that the next drawing starts from it
        except BaseException:
            shutil.rmtree(self.folder / name, ignore_errors=True)
            raise
        self.layers[layer].replace(Canvas.open(self.folder / name))
        return before, self.layers[layer].version

    def shown(self, layer: str) -> dict[tuple[str, int], tuple[Path, BoundingBox]]:
        """(vehicle, sortie) -> solution file and bounds of the sorties on a layer; refined ones hide coarse ones."""
        refined = {(r["vehicle"], r["sortie"]): r for r in self._rows("solutions")}
        rows = {key: row for key, row in refined.items() if json.loads(row["detail"])["layer"] == layer}
        if layer == "coarse":
            rows = {(r["vehicle"], r["sortie"]): r for r in self._rows("coarse")} | rows
        return {key: (self.solutions / row["path"], _bounds(row)) for key, row in sorted(rows.items())}

    def retire(self, path: Path) -> None:
        """Remove a solution file later, as others may be reading it."""
        later = threading.Timer(60.0, path.unlink, kwargs={"missing_ok": True})
        later.daemon = True
        later.start()

    def _task(
        self, layer: str, name: str, sortie: tuple[str, int | None], target: Path, changed: BoundingBox
    ) -> DrawTask:
        mine = (packed(sortie[0]), sortie[1])
        others = [path for key, (path, box) in self.shown(layer).items() if key != mine and box.overlaps(changed)]
        canvas = self.layers[layer].canvas
        old = None if canvas is None else canvas.path
        return DrawTask(
            old=old,
            new=self.folder / name,
            grid=self.area().grid,
            solutions=[*others, target],
            changed=target,
            bounds=changed,
        )

    def _rows(self, table: str) -> list[Any]:
        return self.journal.rows(f"SELECT * FROM {table} ORDER BY vehicle, sortie")


def _bounds(row: Any) -> BoundingBox:
    return BoundingBox(*json.loads(row["detail"])["bounds"])

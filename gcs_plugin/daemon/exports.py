"""Exports of the workspace, and which pictures show a find."""

import contextlib
import math
import os
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.jobs.job_queue import Job
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.workspace_products import PRODUCTS, ExportTask, write_products
from gcs_plugin.daemon.layers.journal_frames import frame_of_row
from gcs_plugin.daemon.layers.layers import Area, Layer
from gcs_plugin.daemon.place_list import pictures_at, places_of
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.console_state import ConsoleState
from gcs_plugin.daemon.store.journal import Change, Journal, packed, unpacked
from gcs_plugin.daemon.store.picture_store import PictureStore
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.tactical.places import Place
from orthoswarm.model.errors import InputError
from orthoswarm.raster import picture_file

_SHOWN: Final = (".jpg", ".webp", ".bmp")  # by all browsers
_VIEW_QUALITY: Final = 90
_zipping: Final = threading.Lock()


def zipped_folder(folder: Path) -> Path:
    """The ZIP of an exported folder, beside it; made once, and again when the folder was exported again.

    It has the time of the folder that it was made from. It is replaced as a whole: somebody may still be loading
    the last one down.

    Raises:
        StorageError: the disk is full or gone.
    """
    path = folder.with_suffix(".zip")
    with _zipping:
        began = folder.stat().st_mtime_ns
        if not path.is_file() or path.stat().st_mtime_ns != began:
            with atomic_write(path) as part:
                shutil.make_archive(str(part.with_suffix("")), "zip", folder)
                os.utime(part, ns=(began, began))  # a folder that was exported again meanwhile has another time
    return path


class Exports:
    """Exports the workspace to the formats of other programs.

    Args:
        settings: of the daemon. journal, store, layers, console: the workspace's.
        workers: write the files. area: returns the map's area, None before the first picture.
        vehicles: returns the rows of /api/vehicles. facts: returns the daemon's facts for the report.
        cells: returns the picture of the coverage's cells (PNG), empty without an area.
    """

    def __init__(
        self,
        settings: Settings,
        journal: Journal,
        *,
        store: PictureStore,
        layers: Mapping[str, Layer],
        console: ConsoleState,
        workers: WorkerPool,
        area: Callable[[], Area | None],
        vehicles: Callable[[], list[dict[str, Any]]],
        facts: Callable[[], dict[str, Any]],
        cells: Callable[[], bytes],
    ) -> None:
        self._settings, self._journal, self._store = settings, journal, store
        self._layers, self._console, self._workers = layers, console, workers
        self._area, self._vehicles, self._facts, self._cells = area, vehicles, facts, cells
        self._written: tuple[dict[str, int], dict[str, str]] = ({}, {})  # the layers' versions, and the files of them

    def write(self, job: Job, report: Callable[[float, str], None]) -> Change:
        """The handler of an `export` job; one that nobody asked for writes only what has changed since the last one.

        Raises:
            InputError: there is no map yet.
        """
        report(0.05, "writing")
        area = self._area()
        if area is None:
            raise InputError("there is no map yet; wait for pictures")
        versions = {name: layer.version for name, layer in self._layers.items()}
        if "after" in job.detail and versions == self._written[0]:
            job.detail["note"], job.detail["files"] = "the last one has everything", self._written[1]
            return lambda db: None
        with contextlib.ExitStack() as held:  # a replaced generation stays while it is read
            canvases = {name: held.enter_context(layer.reading()) for name, layer in self._layers.items()}
            folders = {name: canvas.path for name, canvas in canvases.items() if canvas is not None}
            task = replace(self._task(area), formats=tuple(job.detail["formats"]), canvases=folders)
            shown = [
                find | {"pictures": [row["image"] for row in pictures_at(task, find["lat_deg"], find["lon_deg"])]}
                for find in self._console.finds()
            ]
            places = tuple(self._places(shown))
            task = replace(task, facts=self._facts(), places=places, cells=self._cells())
            job.detail["files"] = files = self._workers.run(write_products, task)
            self._written = versions, {name: files[name] for name in PRODUCTS}
        return lambda db: None

    def places(self) -> list[Place]:
        """The finds, and the vehicles with a known position."""
        return self._places(self._console.finds())

    def find_pictures(self, number: int) -> list[dict[str, Any]]:
        """The pictures that show a find, best first; see `pictures_at`. Each has its `seq`.

        Raises:
            InputError: there is no such find.
        """
        find = next((row for row in self._console.finds() if row["id"] == number), None)
        if find is None:
            raise InputError(f"there is no find {number}; see /api/finds")
        area = self._area()
        rows = [] if area is None else pictures_at(self._task(area), find["lat_deg"], find["lon_deg"])
        query = "SELECT seq FROM frames WHERE vehicle = ? AND image = ?"
        for row in rows:
            found = self._journal.one(query, (packed(row["vehicle"]), packed(row["image"])))
            row["seq"] = None if found is None else found["seq"]
        return rows

    def picture(self, seq: int) -> Path:
        """The file of a picture.

        Raises:
            InputError: there is no such picture.
        """
        row = self._journal.one("SELECT path FROM frames WHERE seq = ?", (seq,)) if 0 <= seq < 2**63 else None
        if row is None or not self._store.path(row["path"]).is_file():
            raise InputError(f"there is no picture {seq}; see /api/frames")
        return self._store.path(row["path"])

    def picture_view(self, seq: int) -> Path | bytes:
        """The file of a picture, or a JPEG where browsers would show it black or not at all.

        Raises:
            InputError: there is no such picture. PictureError: it cannot be read.
        """
        path = self.picture(seq)
        if path.suffix in _SHOWN or (path.suffix == ".png" and picture_file.deep_picture(path.read_bytes()) is None):
            return path
        import simplejpeg

        return bytes(simplejpeg.encode_jpeg(picture_file.read_rgb(path), _VIEW_QUALITY, "RGB"))

    def _places(self, finds: list[dict[str, Any]]) -> list[Place]:
        return places_of(self._settings.workspace.resolve().name, finds, self._vehicles(), time.time())

    def _task(self, area: Area) -> ExportTask:
        """The export task of the workspace, without layers and formats."""
        rows = self._journal.rows("SELECT * FROM frames ORDER BY vehicle, time, seq")
        folder, fov_deg = self._settings.workspace / "solutions", self._settings.fov_min_deg
        solutions = self._journal.rows("SELECT path FROM solutions ORDER BY vehicle, sortie")
        coarse = self._journal.rows(
            "SELECT path FROM coarse c WHERE NOT EXISTS (SELECT 1 FROM solutions s WHERE s.vehicle = c.vehicle"
            " AND s.sortie = c.sortie) ORDER BY vehicle, sortie"
        )
        return ExportTask(
            workspace=self._settings.workspace,
            formats=(),
            canvases={},
            epsg=area.epsg,
            gsd_m=area.gsd_m,
            frames=[frame_of_row(row, self._store) for row in rows],
            reasons={(unpacked(r["vehicle"]), unpacked(r["image"])): r["reason"] for r in rows if r["reason"]},
            coarse=[folder / row["path"] for row in coarse],
            solutions=[folder / row["path"] for row in solutions],
            basemap=self._settings.basemap,
            fov_rad=None if fov_deg is None else math.radians(fov_deg),
        )

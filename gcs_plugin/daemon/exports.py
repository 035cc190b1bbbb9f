"""Exports of the workspace; finds and vehicles as places (for TAK programs, too); pictures that show one; changes.

What changed since the basemap is found after an export, in the background.
"""

import contextlib
import logging
import math
import os
import shutil
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np

from gcs_plugin.daemon.flight_coverage.live_coverage import LiveCoverage
from gcs_plugin.daemon.intake.posted_pose import frame_of_row
from gcs_plugin.daemon.jobs.job_queue import RunningJob
from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.jobs.workspace_products import (
    PRODUCTS,
    ExportTask,
    RunFacts,
    placements,
    writable,
    write_products,
)
from gcs_plugin.daemon.layers.layers import MapArea, MapLayer
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.stoppable_thread import Background
from gcs_plugin.daemon.store.console_state import ConsoleState, FindRow
from gcs_plugin.daemon.store.frame_rows import all_frames, frame_number, frame_path
from gcs_plugin.daemon.store.journal import Change, Journal, no_change
from gcs_plugin.daemon.store.people_rows import People
from gcs_plugin.daemon.store.picture_store import PictureStore
from gcs_plugin.daemon.store.sortie_rows import coarse_only, placed_sorties
from gcs_plugin.daemon.vehicle_names import VehicleRow
from gcs_plugin.daemon.views import Views
from orthoswarm.change.change_files import FIGURES, change_overlay, figures_in
from orthoswarm.export.atomic_file import atomic_write, write_file
from orthoswarm.export.tactical.cursor_on_target import TakAddress, TakSender, event
from orthoswarm.export.tactical.places import Place, sightings
from orthoswarm.model.camera import Camera
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.raster import picture_file

_SHOWN: Final = (".jpg", ".webp", ".bmp")  # by all browsers
_VIEW_QUALITY: Final = 90
_zipping: Final = threading.Lock()
_MOST_SIGHTINGS = 24  # pictures of one place
_SENT_EVERY_S: Final = 2.0
_FINDS_EVERY: Final = 15  # rounds after which all finds are sent again
_log = logging.getLogger(__name__)


class SightingRow(TypedDict, total=False):
    """A picture that shows a place, and where in it (pixels); `seq`: its number.

    outline: longitude and latitude, degrees, of its four corners on the ground; null where one is above the horizon.
    """

    vehicle: str
    image: str
    column: float
    row: float
    stage: str
    outline: list[list[float]] | None
    seq: int | None


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
        layers: by name. drawer: knows the map's area. views: has the vehicles. coverage: its cells and figures are
            part of the report. facts: of the daemon, for the report. people: whose log goes into the pack.
    """

    def __init__(
        self,
        settings: Settings,
        journal: Journal,
        *,
        store: PictureStore,
        layers: Mapping[str, MapLayer],
        console: ConsoleState,
        drawer: Drawer,
        views: Views,
        coverage: LiveCoverage,
        facts: RunFacts,
        people: People,
    ) -> None:
        self._settings, self._journal, self._store = settings, journal, store
        self._layers, self._console = layers, console
        self._drawer, self._views, self._coverage, self._facts = drawer, views, coverage, facts
        self._people = people
        self._written: tuple[dict[str, int], dict[str, str]] = ({}, {})  # the layers' versions, and the files of them

    def write(self, run: RunningJob) -> Change:
        """The handler of an `export` job; one that nobody asked for writes only what has changed since the last one.

        Raises:
            InputError: there is no map yet.
        """
        job = run.job
        run.report(0.05, "writing")
        area = self._drawer.area
        if area is None:
            raise InputError("there is no map yet; wait for pictures")
        versions = {name: layer.version for name, layer in self._layers.items()}
        if "after" in job.detail and versions == self._written[0]:
            job.detail["note"], job.detail["files"] = "the last one has everything", self._written[1]
            return no_change
        with contextlib.ExitStack() as held:  # a replaced generation stays while it is read
            canvases = {name: held.enter_context(layer.reading()) for name, layer in self._layers.items()}
            folders = {name: canvas.path for name, canvas in canvases.items() if canvas is not None}
            task = replace(self._task(area), formats=tuple(job.detail["formats"]), canvases=folders)
            shown = [
                find | FindRow(pictures=[row["image"] for row in pictures_at(task, find["lat_deg"], find["lon_deg"])])
                for find in self._console.finds()
            ]
            places = tuple(self.places(shown))
            covered = self._coverage.result.document
            facts = self._facts.document() | ({} if covered["state"] == "no area" else {"coverage": covered})
            task = replace(task, facts=facts, places=places, cells=self._coverage.result.png)
            if "pack" in task.formats:
                write_file(self._settings.workspace / "log.csv", self._people.table())
            job.detail["files"] = files = run.run(write_products, task)
            self._written = versions, {name: files[name] for name in PRODUCTS}
        return no_change

    def places(self, finds: Sequence[FindRow] | None = None) -> list[Place]:
        """The finds (default: the operator's), and the vehicles with a known position."""
        found, name = self._console.finds() if finds is None else finds, self._settings.workspace.resolve().name
        return places_of(name, found, self._views.vehicles(), time.time())

    def find_pictures(self, number: int) -> list[SightingRow]:
        """The pictures that show a find, best first; see `pictures_at`. Each has its `seq`.

        Raises:
            InputError: there is no such find.
        """
        find = next((row for row in self._console.finds() if row["id"] == number), None)
        if find is None:
            raise InputError(f"there is no find {number}; see /api/finds")
        return self.pictures_of(find["lat_deg"], find["lon_deg"])

    def pictures_of(self, lat_deg: float, lon_deg: float) -> list[SightingRow]:
        """The pictures that show a place, best first; see `pictures_at`. Each has its `seq`."""
        area = self._drawer.area
        rows = [] if area is None else pictures_at(self._task(area), lat_deg, lon_deg)
        for row in rows:
            row["seq"] = frame_number(self._journal, row["vehicle"], row["image"])
        return rows

    def placed(self) -> tuple[list[PlacedFrame], float, LocalGrid]:
        """Where the pictures are now, on which level of the ground, metres, and in which grid.

        Raises:
            InputError: there is no map yet.
        """
        area = self._drawer.area
        if area is None:
            raise InputError("there is no map yet; wait for pictures")
        return (*_placed_of(self._task(area)), LocalGrid(area.epsg))

    def picture(self, seq: int) -> Path:
        """The file of a picture; raises InputError: there is no such picture."""
        name = frame_path(self._journal, seq)
        if name is None or not self._store.path(name).is_file():
            raise InputError(f"there is no picture {seq}; see /api/frames")
        return self._store.path(name)

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

    def _task(self, area: MapArea) -> ExportTask:
        """The export task of the workspace, without layers and formats."""
        rows = all_frames(self._journal)
        folder, fov_deg = self._settings.workspace / "solutions", self._settings.fov_min_deg
        return ExportTask(
            workspace=self._settings.workspace,
            formats=(),
            canvases={},
            epsg=area.epsg,
            gsd_m=area.gsd_m,
            frames=[frame_of_row(row, self._store) for row in rows],
            reasons={(row.vehicle, row.image): row.reason for row in rows if row.reason},
            coarse=[folder / row.path for row in coarse_only(self._journal)],
            solutions=[folder / row.path for row in placed_sorties(self._journal, "solutions")],
            basemap=self._settings.basemap,
            fov_rad=None if fov_deg is None else math.radians(fov_deg),
        )


def places_of(workspace: str, finds: Iterable[FindRow], vehicles: Iterable[VehicleRow], now_s: float) -> list[Place]:
    """The workspace's finds, and the vehicles with a known position.

    Args:
        workspace: its name, which makes ids unique. finds: as ConsoleState gives them. vehicles: rows of
            /api/vehicles. now_s: UTC epoch seconds; a vehicle's place is as old as its last message.
    """
    workspace = writable(workspace)
    found = [
        Place(
            uid=f"orthoswarm-{workspace}-find-{row['id']}", kind="find", name=_name(row), lat_deg=row["lat_deg"],
            lon_deg=row["lon_deg"], sigma_m=row["sigma_m"], note=writable(row["note"]),
            time_s=datetime.fromisoformat(str(row["time"])).timestamp(), pictures=tuple(row.get("pictures", ())),
        )
        for row in finds
    ]  # fmt: skip
    for row in vehicles:
        lat, lon = row.get("lat_deg"), row.get("lon_deg")
        if lat is None or lon is None or "system" not in row:
            continue
        found.append(
            Place(
                uid=f"orthoswarm-{workspace}-{row['id']}", kind="vehicle", name=row.get("name") or row["id"],
                lat_deg=lat, lon_deg=lon, time_s=now_s - float(row.get("silent_s") or 0.0),
                course_deg=row.get("heading_deg"), speed_m_s=row.get("speed_m_s"),
                note=(row.get("flight") or {}).get("text", ""),
            )
        )  # fmt: skip
    return found


def _name(find: FindRow) -> str:
    note = writable(find["note"]).strip()
    return note.splitlines()[0][:60] if note else f"Find {find['id']}"


def _placed_of(task: ExportTask) -> tuple[list[PlacedFrame], float]:
    return placements(task, [read_solution(path).solution for path in (*task.coarse, *task.solutions)])


def pictures_at(task: ExportTask, lat_deg: float, lon_deg: float) -> list[SightingRow]:
    """The pictures that show a place, best first, as JSON values, see `SightingRow`."""
    placed, level = _placed_of(task)
    grid = LocalGrid(task.epsg)
    east, north = (float(v) for v in grid.to_grid(lat_deg, lon_deg))

    def outline(camera: Camera) -> list[list[float]] | None:
        corners = camera.corners(level)
        return grid.to_geographic(corners)[:, ::-1].tolist() if np.isfinite(corners).all() else None

    return [
        {
            "vehicle": s.placed.frame.vehicle, "image": s.placed.frame.image, "column": round(s.column, 1),
            "row": round(s.row, 1), "stage": s.placed.stage, "outline": outline(s.placed.camera),
        }
        for s in sightings(placed, (east, north, level))[:_MOST_SIGHTINGS]
    ]  # fmt: skip


class TakFeed(Background):
    """Sends all vehicles every two seconds, and all finds when one is new or changed and every half minute.

    Attributes:
        problem: why a receiver gets nothing at present, else empty.
    """

    def __init__(self, addresses: Sequence[TakAddress], exports: Exports) -> None:
        super().__init__("tak", join_s=10.0)
        self._senders = [TakSender(address) for address in addresses]
        self._exports = exports
        self.problem = ""

    def start(self) -> None:
        """Start sending, if there is a receiver."""
        if self._senders:
            super().start()

    def close(self) -> None:
        """Stop sending."""
        super().close()
        for sender in self._senders:
            sender.close()

    def _run(self) -> None:
        number, known = 0, set[Place]()
        while not self._stop.wait(_SENT_EVERY_S):
            try:
                places = self._exports.places()
            except (OrthoSwarmError, TimeoutError) as error:
                _log.warning("TAK: %s", error)
                continue
            finds = {place for place in places if place.kind == "find"}
            everything = number % _FINDS_EVERY == 0 or not finds <= known
            number, known = number + 1, finds
            now = time.time()
            events = [event(place, now) for place in places if everything or place.kind == "vehicle"]
            self.problem = "; ".join(text for sender in self._senders if (text := _sent(sender, events)))


def _sent(sender: TakSender, events: Sequence[bytes]) -> str:
    """Send all events; returns the reason of a failure, else an empty text."""
    try:
        for one in events:
            sender.send(one)
    except OrthoSwarmError as error:
        return str(error)
    return ""


@dataclass(frozen=True, slots=True)
class ChangeTask:
    """What is compared: a workspace and its basemap; `pictures`: (vehicle, image) -> file."""

    workspace: Path
    basemap: Path
    pictures: Mapping[tuple[str, str], Path]


def find_change(task: ChangeTask) -> dict[str, Any]:
    """Compare the products of a workspace with its basemap; returns the shares."""
    from orthoswarm.change.of_folder import change_of
    from orthoswarm.report.page import put_section

    figures = change_of(
        task.workspace, task.workspace, basemap=task.basemap,
        find=lambda vehicle, image: task.pictures.get((vehicle, image)),
    )  # fmt: skip
    put_section(task.workspace, task.workspace)
    return {key: figures[key] for key in ("changed_share", "not_visible_share", "count", "warnings")}


class GroundChanges:
    """Does the jobs `change`, and answers the page."""

    def __init__(self, settings: Settings, journal: Journal, store: PictureStore) -> None:
        self._settings, self._journal, self._store = settings, journal, store

    def find(self, run: RunningJob) -> Change:
        """The handler of a `change` job."""
        workspace, basemap = self._settings.workspace, self._settings.basemap
        if basemap is None or not (workspace / "orthoimage.tif").exists():
            run.job.detail["note"] = "nothing is refined on a basemap"
            return no_change
        compared = workspace / FIGURES
        if compared.exists() and compared.stat().st_mtime_ns >= (workspace / "orthoimage.tif").stat().st_mtime_ns:
            run.job.detail["note"] = "the last one has everything"
            return no_change
        run.report(0.1, "comparing with the basemap")
        pictures = {
            (writable(row.vehicle), writable(row.image)): self._store.path(row.path)
            for row in all_frames(self._journal)
        }
        run.job.detail |= run.run(find_change, ChangeTask(workspace, basemap, pictures))
        return no_change

    def document(self) -> dict[str, Any]:
        """The figures of the last comparison, with `version` (0: none yet) and the `corners` of its picture."""
        version, figures = self._version(), figures_in(self._settings.workspace)
        if not version or figures is None:
            return {"version": 0, "objects": [], "corners": None}
        return figures | {"version": version, "corners": _overlay(self._settings.workspace, version, 0.5)[1]}

    def picture(self, threshold: float) -> tuple[bytes, int] | None:
        """The overlay from a probability on, PNG, and its version; None if nothing was compared yet."""
        version = self._version()
        return (_overlay(self._settings.workspace, version, threshold)[0], version) if version else None

    def _version(self) -> int:
        path = self._settings.workspace / FIGURES
        return path.stat().st_mtime_ns // 1_000_000 if path.is_file() else 0


@lru_cache(maxsize=8)
def _overlay(workspace: Path, _version: int, threshold: float) -> tuple[bytes, list[list[float]]]:
    """See change_overlay: computed once a version and threshold, for all pages."""
    return change_overlay(workspace, threshold)

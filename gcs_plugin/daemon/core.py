"""The daemon without its web server: owns the workspace, takes pictures and telemetry in, has maps made of them."""

import json
import logging
import math
import os
import shutil
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.crew import Crew
from gcs_plugin.daemon.drawing import Drawer, frame_of_row
from gcs_plugin.daemon.events import Events
from gcs_plugin.daemon.flock import Flock, completion_rows, note_completion
from gcs_plugin.daemon.jobs import Job, Jobs
from gcs_plugin.daemon.journal import Change, Journal, add_frame, packed, unpacked
from gcs_plugin.daemon.layers import NAMES, Area, Layer, drawn_bounds
from gcs_plugin.daemon.plans import Plans
from gcs_plugin.daemon.pose import PostedPose, frame_of
from gcs_plugin.daemon.products import FORMATS, ExportTask, facts_of, write_products
from gcs_plugin.daemon.refinement import Refinement
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.sources import Source
from gcs_plugin.daemon.store import PictureStore, frame_key, picture_size
from gcs_plugin.daemon.tiles import TileServer
from orthoswarm.basemap import Basemap
from orthoswarm.errors import InputError, OrthoSwarmError
from orthoswarm.geo import LocalGrid
from orthoswarm.products import iso_time
from orthoswarm.workspace import Workspace
from telemetry.sample import Sample

_LOCK_S: Final = 5.0
_FREE_MB: Final = 50.0
_log = logging.getLogger(__name__)


class Daemon:
    """All of the daemon but HTTP.

    Attributes:
        settings: what it was told. journal, store, layers, tiles, events, drawer, jobs: its parts.
        started: when, UTC epoch seconds.
    """

    def __init__(self, settings: Settings) -> None:
        """Take over a workspace and go on where the last daemon stopped.

        Raises:
            InputError: another daemon runs in the workspace, or the basemap is of no use.
            OrthoSwarmError: the workspace cannot be written.
        """
        self.settings, self.started = settings, time.time()
        self.events = Events()
        self._lock = _take_over(settings.workspace)
        try:
            self._open()
        except BaseException:
            self._lock.close()
            raise

    def _open(self) -> None:
        settings, folder = self.settings, self.settings.workspace
        self.journal = Journal(folder / "journal.db")
        self.store = PictureStore(folder / "pictures")
        self.layers = {name: Layer(name) for name in NAMES}
        self.tiles = TileServer(self.layers)
        canvases = folder / "layers"
        canvases.mkdir(exist_ok=True)
        self._distrust_after_power_cut()
        self.tiles.basemap = None if settings.basemap is None else open_basemap(settings.basemap)
        fov = None if settings.fov_min_deg is None else math.radians(settings.fov_min_deg)
        self.drawer = Drawer(
            self.journal, self.store, self.layers["realtime"], canvases, self.events, gsd_m=settings.gsd_m,
            fov_rad=fov, on_area=self._area_changed,
        )  # fmt: skip
        self.crew = Crew(settings.workers)
        self.refinement = Refinement(
            self.journal, self.store, self.layers, canvases, folder / "solutions", self.crew, self.drawer,
            settings.basemap, self._published,
        )  # fmt: skip
        handlers = {"refine": self.refinement.refine, "export": self._export}
        self.jobs = Jobs(self.journal, self.events, handlers, slots=settings.workers + 1)
        self.jobs.on_end(self._after_job)
        self.posted: Counter[str] = Counter()
        self.plans = Plans(folder / "plans")
        self.flock: Flock | None = None
        if settings.links:
            self.flock = Flock(settings, self.journal, self.events, self.jobs)
        self.sources = [
            Source(v.id, v.pictures, self.add_picture, self._pose_at, self._say, folder / "videos")
            for v in settings.vehicles
            if v.pictures
        ]

    def start(self) -> None:
        """Begin to draw and to work."""
        if self.drawer.area is not None:
            self._area_changed(self.drawer.area)
        self.drawer.start()
        self.jobs.start()
        threading.Thread(target=self.crew.warm_up, daemon=True).start()
        if self.flock is not None:
            self.flock.start()
        for source in self.sources:
            source.start()

    def close(self) -> None:
        """Stop; what is under way goes on at the next start."""
        for source in self.sources:
            source.close()
        if self.flock is not None:
            self.flock.close()
        self.jobs.give_up()
        self.crew.close()
        self.jobs.close()
        self.drawer.close()
        for layer in self.layers.values():
            layer.close()
        self.journal.remember("clean", True)
        self.journal.close()
        self._lock.close()

    def __enter__(self) -> "Daemon":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- pictures -------------------------------------------------------------------------------------------------

    def add_picture(self, pose: PostedPose, data: bytes) -> tuple[int, bool]:
        """Take a picture in; when this returns it is safe on the disk.

        Returns:
            The frame's number, and False if it was there already (the first one stays).

        Raises:
            InputError: the file is no picture.
            OrthoSwarmError: the disk is full or gone; nothing was kept.
        """
        key = frame_key(pose.vehicle, pose.image)
        known = self.journal.one("SELECT seq FROM frames WHERE key = ?", (key,))
        if known is not None:
            return int(known["seq"]), False
        width, height, suffix = picture_size(data)
        self.require_space(len(data))
        time_s = time.time() if pose.time_s is None else pose.time_s
        path = self.store.put(key, suffix, data)
        change = add_frame(key, pose.vehicle, pose.image, time_s, path, (width, height), pose.values)
        seq, new = self.journal.write(change)
        if new:
            frame = frame_of(
                pose.values, image=pose.image, path=self.store.path(path), vehicle=pose.vehicle, time_s=time_s,
                size=(width, height),
            )  # fmt: skip
            self.posted[pose.vehicle] += 1
            self.drawer.add(seq, frame, time.time(), self.sortie(pose.vehicle))
        return seq, new

    def require_space(self, size: int) -> None:
        """Refuse what would fill the disk, while there is room to say so.

        Raises:
            OrthoSwarmError: there is too little room.
        """
        try:
            free = shutil.disk_usage(self.settings.workspace).free
        except OSError as error:
            raise OrthoSwarmError(f"the workspace cannot be reached ({error.strerror}); connect its disk") from None
        if free < _FREE_MB * 1e6 + size:
            raise OrthoSwarmError(f"the disk is nearly full ({free / 1e6:.0f} MB left); free some space")

    def sortie(self, vehicle: str) -> int:
        """The vehicle's present sortie."""
        row = self.journal.one("SELECT sortie FROM vehicles WHERE id = ?", (packed(vehicle),))
        return 1 if row is None else int(row["sortie"])

    def frames(self, vehicle: str | None = None, since: float | None = None, limit: int | None = None) -> list[
        dict[str, Any]
    ]:  # fmt: skip
        """Frames in the order in which they came, as JSON values; see the HTTP API."""
        where, values = ["1"], list[Any]()
        if vehicle is not None:
            where.append("vehicle = ?")
            values.append(packed(vehicle))
        if since is not None:
            where.append("time >= ?")
            values.append(since)
        query = f"SELECT * FROM frames WHERE {' AND '.join(where)} ORDER BY seq LIMIT ?"
        return [_frame_row(row) for row in self.journal.rows(query, [*values, -1 if limit is None else limit])]

    def vehicles(self) -> list[dict[str, Any]]:
        """All vehicles that were heard or sent pictures, as JSON values."""
        query = (
            "SELECT v.id, v.sortie, COUNT(f.seq) AS frames, SUM(f.stage = 'fine') AS fine,"
            " SUM(f.stage = 'coarse') AS coarse, SUM(f.stage = 'rejected') AS rejected, MAX(f.seq) AS last"
            " FROM vehicles v LEFT JOIN frames f ON f.vehicle = v.id GROUP BY v.id ORDER BY v.rowid"
        )
        last = {
            row["seq"]: row
            for row in self.journal.rows(
                "SELECT seq, time, pose FROM frames WHERE seq IN (SELECT MAX(seq) FROM frames GROUP BY vehicle)"
            )
        }
        named = {v.id: v for v in self.settings.vehicles}
        out = []
        for row in self.journal.rows(query):
            name = unpacked(row["id"])
            document: dict[str, Any] = {"id": name, "state": "pictures", "sortie": row["sortie"]}
            if name in named and named[name].name:
                document["name"] = named[name].name
            document["frames"] = {k: row[k] or 0 for k in ("frames", "fine", "coarse", "rejected")}
            if row["last"] in last:
                pose = json.loads(last[row["last"]]["pose"])
                document |= {key: pose.get(key) for key in ("lat_deg", "lon_deg", "height_m")}
                document |= {"heading_deg": pose.get("yaw_deg"), "last_frame": iso_time(last[row["last"]]["time"])}
            out.append(document)
        linked = {} if self.flock is None else {row["id"]: row for row in self.flock.rows()}
        documents = {document["id"]: document for document in out}
        for name, heard in linked.items():
            documents[name] = documents.get(name, {"sortie": 1, "frames": {}}) | heard
        for source in self.sources:
            documents.setdefault(source.vehicle, {"id": source.vehicle, "state": "waiting", "frames": {}, "sortie": 1})
            documents[source.vehicle]["pictures"] = source.document()
        return list(documents.values())

    def legs(self) -> dict[str, Any]:
        """The legs of refined vehicles as GeoJSON lines with state, confidence and sigma."""
        features = []
        for row in self.journal.rows("SELECT * FROM solutions"):
            frames = self.journal.rows(
                "SELECT pose FROM frames WHERE vehicle = ? AND sortie = ? AND reason IS NULL ORDER BY time, seq",
                (row["vehicle"], row["sortie"]),
            )
            for number, leg in enumerate(json.loads(row["detail"])["legs"], start=1):
                poses = [json.loads(f["pose"]) for f in frames[leg["first"] : leg["last"] + 1]]
                if len(poses) < 2:
                    continue
                line = [[p["lon_deg"], p["lat_deg"]] for p in (poses[0], poses[-1])]
                about = {"vehicle": unpacked(row["vehicle"]), "sortie": row["sortie"], "leg": number}
                about |= {key: leg[key] for key in ("state", "confidence", "sigma_m")}
                geometry = {"type": "LineString", "coordinates": line}
                features.append({"type": "Feature", "properties": about, "geometry": geometry})
        return {"type": "FeatureCollection", "features": features}

    def completions(self) -> list[dict[str, Any]]:
        """When vehicles completed, and what followed."""
        return completion_rows(self.journal)

    def _pose_at(self, vehicle: str, time_s: float) -> Sample | None:
        return None if self.flock is None else self.flock.pose_at(vehicle, time_s)

    def _say(self, text: str) -> None:
        _log.info("%s", text)
        self.events.publish("note", text=text)

    # -- layers ---------------------------------------------------------------------------------------------------

    def layer_rows(self) -> list[dict[str, Any]]:
        """The layers as JSON values, the basemap first."""
        rows = []
        if self.tiles.basemap is not None:
            basemap = self.tiles.basemap
            rows.append(self._layer_row("basemap", 1, basemap.epsg, basemap.bounds, basemap.native_gsd_m))
        boxes = []
        for name, layer in self.layers.items():
            with layer.reading() as canvas:
                version = 0 if canvas is None else canvas.version
                bounds = None if canvas is None else drawn_bounds(canvas)
                epsg, gsd = (None, None) if canvas is None else (canvas.grid.epsg, canvas.grid.gsd_m)
            rows.append(self._layer_row(name, version, epsg, bounds, gsd))
            boxes.append((version, epsg, bounds, gsd))
        shown = [box for box in boxes if box[2] is not None]
        if shown:
            from gcs_plugin.daemon.layers import union

            bounds = union([b for _, _, b, _ in shown if b is not None])
            rows.append(self._layer_row("best", sum(v for v, *_ in shown), shown[0][1], bounds, shown[0][3]))
        else:
            rows.append(self._layer_row("best", 0, None, None, None))
        return rows

    def _layer_row(self, name: str, version: int, epsg: int | None, bounds: Any, gsd_m: float | None) -> dict[str, Any]:
        row: dict[str, Any] = {
            "name": name, "version": version, "empty": bounds is None, "epsg": epsg, "gsd_m": gsd_m, "bounds": None,
            "tiles": f"/tiles/{name}/{{z}}/{{x}}/{{y}}.webp", "maxzoom": 22,
        }  # fmt: skip
        if bounds is not None and epsg is not None:
            west, south, east, north = bounds
            ring = LocalGrid(epsg).to_geographic([[west, south], [west, north], [east, south], [east, north]])
            low, high = ring.min(0), ring.max(0)
            row["bounds"] = [float(low[1]), float(low[0]), float(high[1]), float(high[0])]
        return row

    def _area_changed(self, area: Area) -> None:
        """Read the basemap on the area's grid."""
        basemap = self.tiles.basemap
        if self.settings.basemap is not None and (basemap is None or basemap.epsg != area.epsg):
            self.tiles.basemap = Basemap.open(self.settings.basemap, area.epsg)

    def _published(self, layer: str, job: Job) -> None:
        version = self.layers[layer].version
        self.events.publish("layer", layer=layer, version=version, vehicle=job.vehicle, sortie=job.sortie)

    # -- refinement -----------------------------------------------------------------------------------------------

    def refine(self, vehicle: str | None = None) -> list[Job]:
        """Queue the refinement of a vehicle's last sortie, or of all sorties that have pictures.

        Raises:
            InputError: the vehicle has sent no picture.
        """
        rows = self.journal.rows("SELECT vehicle, sortie FROM frames GROUP BY vehicle, sortie ORDER BY MIN(seq)")
        wanted = [(unpacked(row["vehicle"]), int(row["sortie"])) for row in rows]
        if vehicle is not None:
            wanted = [pair for pair in wanted if pair[0] == vehicle][-1:]
            if not wanted:
                raise InputError(f"vehicle {vehicle} has sent no picture; see /api/vehicles")
        return [self.jobs.add("refine", name, sortie) for name, sortie in wanted]

    def _after_job(self, job: Job) -> None:
        """Note what a completion led to; write the products once nothing is left to refine."""
        if job.kind != "refine":
            return
        if job.state == "done" and job.vehicle is not None:
            facts = {
                "refine_started_s": job.detail["refine_started_s"], "refine_ended_s": job.detail["published_s"],
                "layer": job.detail["layer"], "version_before": job.detail["version_before"],
                "version": job.detail["version"], "frames": job.detail["frames"],
            }  # fmt: skip
            if self.flock is not None:
                facts["still_flying_after"] = [r["id"] for r in self.flock.rows() if r["mission"]["phase"] == "active"]
            self.journal.write(note_completion(job.vehicle, job.sortie, facts))
            self.events.publish("completion", vehicle=job.vehicle, sortie=job.sortie, **facts)
        if not self.jobs.open("refine"):
            self.jobs.add("export", formats=["cog", "gpkg"])

    # -- export ---------------------------------------------------------------------------------------------------

    def export(self, formats: Sequence[str]) -> Job:
        """Queue an export.

        Raises:
            InputError: an unknown format.
        """
        unknown = [name for name in formats if name not in FORMATS]
        if unknown or not formats:
            raise InputError(f"there is no format {unknown or 'given'}; choose from: {', '.join(FORMATS)}")
        return self.jobs.add("export", formats=list(dict.fromkeys(formats)))

    def _export(self, job: Job, tell: Callable[[float, str], None]) -> Change:
        """The handler of `export`."""
        tell(0.05, "writing")
        area = self.drawer.area
        if area is None:
            raise InputError("there is no map yet; wait for pictures")
        rows = self.journal.rows("SELECT * FROM frames ORDER BY vehicle, time, seq")
        canvases = {}
        for name, layer in self.layers.items():
            with layer.reading() as canvas:
                if canvas is not None:
                    canvases[name] = canvas.path
        solutions = self.journal.rows("SELECT path FROM solutions ORDER BY vehicle, sortie")
        from gcs_plugin.daemon.metrics import resident_mb

        facts = facts_of(
            [j.document() for j in self.jobs.all()], self.completions(), time.time() - self.started,
            time.process_time(), resident_mb(),
        )  # fmt: skip
        task = ExportTask(
            self.settings.workspace, tuple(job.detail["formats"]), canvases, area.epsg, area.gsd_m,
            [frame_of_row(row, self.store) for row in rows],
            {(unpacked(r["vehicle"]), unpacked(r["image"])): r["reason"] for r in rows if r["reason"]},
            [self.settings.workspace / "solutions" / row["path"] for row in solutions], self.settings.basemap,
            None if self.settings.fov_min_deg is None else math.radians(self.settings.fov_min_deg), facts,
        )  # fmt: skip
        job.detail["files"] = self.crew.run(write_products, task)
        return lambda db: None

    # -- health ---------------------------------------------------------------------------------------------------

    def problems(self) -> list[str]:
        """What is wrong at present, in words."""
        return [self.drawer.problem] if self.drawer.problem else []

    def _distrust_after_power_cut(self) -> None:
        """After the machine went down without the daemon, draw the real-time layer again: its last pixels may be lost.

        Pictures and journal are synced before they are acknowledged; canvases are not, for speed.
        """
        boot = _boot_id()
        clean = self.journal.fact("clean") or self.journal.fact("boot") in (None, boot)

        def change(db: sqlite3.Connection) -> None:
            db.execute("INSERT OR REPLACE INTO meta VALUES ('boot', ?)", (json.dumps(boot),))
            db.execute("INSERT OR REPLACE INTO meta VALUES ('clean', 'false')")
            if not clean:
                db.execute("UPDATE frames SET drawn = 0")
                db.execute("DELETE FROM meta WHERE key = 'realtime'")

        self.journal.write(change)
        if not clean:
            _log.warning("the machine went down without warning; the real-time layer is drawn again")


def _frame_row(row: sqlite3.Row) -> dict[str, Any]:
    pose = json.loads(row["pose"])
    return {
        "seq": row["seq"], "image": unpacked(row["image"]), "vehicle": unpacked(row["vehicle"]),
        "time": iso_time(row["time"]), "stage": row["stage"], "sigma_m": row["sigma"], "reason": row["reason"],
        "sortie": row["sortie"], "on_map": bool(row["drawn"]) and row["reason"] is None,
        "width": row["width"], "height": row["height"], **pose,
    }  # fmt: skip


def _take_over(workspace: Path) -> Workspace:
    """The workspace's lock; one that a dying daemon still holds is waited for."""
    end = time.monotonic() + _LOCK_S
    while True:
        try:
            return Workspace(workspace)
        except InputError:
            if workspace.is_file() or time.monotonic() > end:
                raise
            time.sleep(0.1)


def _boot_id() -> str:
    """What tells this start of the machine from the next."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return str(round((time.time() - time.monotonic()) / 60.0)) if os.name == "nt" else ""


def open_basemap(path: Path) -> Basemap | None:
    """The basemap on the grid of its own middle, to be shown before there is an area; None where that is not known."""
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.warp import transform_bounds

    from orthoswarm.geo import utm_epsg

    if path.is_dir():
        return None
    try:
        with rasterio.open(path) as raster:
            if raster.crs is None:
                raise InputError(f"the basemap {path.name} has no coordinate system; give a georeferenced map")
            west, south, east, north = transform_bounds(raster.crs, 4326, *raster.bounds)
    except RasterioError as error:
        raise InputError(f"the basemap {path.name} cannot be read ({error}); check the file") from None
    return Basemap.open(path, utm_epsg(0.5 * (south + north), 0.5 * (west + east)))

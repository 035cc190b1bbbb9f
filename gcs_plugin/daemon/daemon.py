"""The daemon without its web server: owns the workspace, receives pictures and telemetry, has maps made from them."""

import json
import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

from gcs_plugin.daemon import views
from gcs_plugin.daemon.airspace.terrain_data import TerrainData
from gcs_plugin.daemon.exports import Exports
from gcs_plugin.daemon.fetched_pictures import make_picture_requests
from gcs_plugin.daemon.flight_coverage.exposure_journal import MESSAGES as EVENT_MESSAGES
from gcs_plugin.daemon.flight_coverage.exposure_journal import EventRequests, ExposureJournal
from gcs_plugin.daemon.flight_coverage.live_coverage import LiveCoverage
from gcs_plugin.daemon.flight_coverage.picture_views import PictureViews
from gcs_plugin.daemon.flight_coverage.planned_area import area_source
from gcs_plugin.daemon.gap_flights import GapFlights
from gcs_plugin.daemon.intake.can_reader import CanReader
from gcs_plugin.daemon.intake.picture_sources import Source
from gcs_plugin.daemon.intake.posted_pose import PostedPose, frame_of, linked_pose
from gcs_plugin.daemon.intake.refused_pictures import RefusedPictures
from gcs_plugin.daemon.jobs.job_queue import Job, Jobs
from gcs_plugin.daemon.jobs.joint_refinement import JointRefinement
from gcs_plugin.daemon.jobs.leg_placement import LegPlacement
from gcs_plugin.daemon.jobs.leg_watch import LegWatch
from gcs_plugin.daemon.jobs.publisher import Publisher
from gcs_plugin.daemon.jobs.sortie_refinement import SortieRefinement
from gcs_plugin.daemon.jobs.tone_balance import ToneBalance
from gcs_plugin.daemon.jobs.worker_pool import LAST, WorkerPool
from gcs_plugin.daemon.jobs.workspace_products import FORMATS, PRODUCTS, facts_of
from gcs_plugin.daemon.layers.anchor import Anchor
from gcs_plugin.daemon.layers.layers import NAMES, Area, Layer
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.layers.web_tiles import TileServer
from gcs_plugin.daemon.mission_journal import completion_rows, note_completion
from gcs_plugin.daemon.settings import Settings, system_in_name
from gcs_plugin.daemon.store.console_state import ConsoleState
from gcs_plugin.daemon.store.event_bus import Events
from gcs_plugin.daemon.store.journal import Journal, add_frame, late_frames, packed, unpacked
from gcs_plugin.daemon.store.kept_pictures import KeptPictures
from gcs_plugin.daemon.store.picture_store import PictureStore, frame_key, picture_size
from gcs_plugin.daemon.store.workspace_lock import distrust_after_power_cut, open_basemap, require_space, take_over
from gcs_plugin.daemon.tak_feed import TakFeed
from gcs_plugin.daemon.takeoffs import Takeoffs
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.daemon.web_plans import Plans
from orthoswarm.compute.workers import peak_rss_mb, prepare_process
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Frame
from orthoswarm.raster.basemap import Basemap
from telemetry.live.live_poses import LinkPoses

_FEW: Final = 10  # posted pictures of a vehicle, after which the kernels of a refinement are compiled
_SOURCES_S: Final = 1.0
_REPLACED: Final = "dropped: the vehicle's refinement takes its place"
_log = logging.getLogger(__name__)


class Part(Protocol):
    """What works in threads of its own."""

    def start(self) -> None:
        """Begin to work."""


class Daemon:
    """All of the daemon but HTTP.

    Attributes:
        settings: of the daemon. journal, store, layers, tiles, events, drawer, jobs: its parts.
        started: when, UTC epoch seconds.
    """

    def __init__(self, settings: Settings) -> None:
        """Open a workspace and continue where the last daemon stopped.

        Raises:
            InputError: another daemon runs in the workspace, or the basemap cannot be used.
            OrthoSwarmError: the workspace cannot be written.
        """
        prepare_process()
        self.settings, self.started = settings, time.time()
        self.events = Events()
        self._lock = take_over(settings.workspace)
        try:
            self._open()
        except BaseException:
            self._lock.close()
            raise

    def _open(self) -> None:
        """Open the workspace; each part may need those before it."""
        self._open_records()
        self._open_drawing()
        self._open_jobs()
        self._open_links()
        self._open_sources()

    def _open_records(self) -> None:
        """What is kept in the workspace, and what is published of it."""
        settings, folder = self.settings, self.settings.workspace
        self.journal = Journal(folder / "journal.db")
        self.store = PictureStore(folder / "pictures")
        self.layers = {name: Layer(name) for name in NAMES}
        self.tiles = TileServer(self.layers)
        self._trusted = distrust_after_power_cut(self.journal)
        self.tiles.basemap = None if settings.basemap is None else open_basemap(settings.basemap)
        self.refused = RefusedPictures(self.events.publish)
        self.console = ConsoleState(self.journal, self.events.publish)
        self.plans = Plans(
            folder / "plans", settings.dem, lambda: self.links.autopilots(), standing=lambda: self.links.standing()
        )

    def _open_drawing(self) -> None:
        """The map that grows in flight, and how well the area is seen."""
        settings, folder = self.settings, self.settings.workspace
        canvases = folder / "layers"
        canvases.mkdir(exist_ok=True)
        fov = None if settings.fov_min_deg is None else math.radians(settings.fov_min_deg)
        self.drawer = Drawer(
            self.journal, self.store, self.layers["realtime"], canvases, self.events, gsd_m=settings.gsd_m,
            fov_rad=fov, on_area=self._area_changed, anchor=self._anchor, on_rejected=self._rejected,
            on_drawn=lambda placed, quality: self.coverage.add(placed, quality),
        )  # fmt: skip
        self.exposures = ExposureJournal(self.journal, lambda system: self.links.name_of(system))
        self.coverage = LiveCoverage(
            self.journal, self.events, views=PictureViews(self.journal, self.store, folder / "solutions", fov),
            source=lambda: area_source(self.console.plan(), self.plans.folder),
            epsg=lambda: None if self.drawer.area is None else self.drawer.area.epsg,
            vehicles=lambda: self.links.latest, exposures=self.exposures,
        )  # fmt: skip

    def _open_jobs(self) -> None:
        """What refines, publishes and exports in the background, and what a stop left undone of it."""
        settings, folder = self.settings, self.settings.workspace
        self.workers, self.background = WorkerPool(settings.workers), WorkerPool(1, LAST)
        publisher = Publisher(
            self.journal, self.layers, folder / "layers", folder / "solutions", self.drawer, trusted=self._trusted
        )
        shared: dict[str, Any] = {"journal": self.journal, "publisher": publisher, "on_published": self._published}
        one = shared | {"store": self.store, "kept": KeptPictures(folder / "kept"), "basemap": settings.basemap}
        self.coarse = LegPlacement(workers=self.background, **one)
        self.refinement = SortieRefinement(
            workers=self.workers, drawer=self.drawer, make_way=self._make_way, stopped=lambda: self.jobs.stopping, **one
        )
        self.together = JointRefinement(
            workers=self.background, basemap=settings.basemap, least_px=settings.redraw_px, **shared
        )
        self.tones = ToneBalance(workers=self.background, layer="fine" if settings.basemap else "coarse", **shared)
        self.exports = Exports(
            settings=settings, journal=self.journal, store=self.store, layers=self.layers, console=self.console,
            workers=self.background, area=lambda: self.drawer.area, vehicles=self.vehicles, facts=self._facts,
            cells=lambda: self.coverage.png,
        )  # fmt: skip
        handlers = {
            "refine": self.refinement.refine, "together": self.together.solve, "coarse": self.coarse.make,
            "tones": self.tones.balance, "export": self.exports.write,
            "redraw": lambda job, report: publisher.draw_again(self.background, report),
        }  # fmt: skip
        self.jobs = Jobs(
            self.journal, self.events, handlers, settings.workers, lambda job: self.coarse.give_up(job.vehicle)
        )
        self.jobs.on_end(self._after_job)
        if publisher.lost:
            self.jobs.add("redraw")
        for vehicle, sortie in publisher.outdated:
            self.jobs.add("refine", vehicle, sortie)
        self.leg_watch = LegWatch(self._leg_over, self._refine_late, silent_s=settings.silent_s)

    def _open_links(self) -> None:
        """The vehicles on their links, what is asked of them and what is shown of them to others."""
        settings = self.settings
        self.posted: Counter[str] = Counter()
        self.poses = LinkPoses()
        self.links = VehicleLinks(settings, self.journal, self.events, self.jobs, self.poses)
        self.takeoffs = Takeoffs(self.links, self.plans, self._say)
        self.links.fleet.subscribe(self.exposures.message, *EVENT_MESSAGES)
        EventRequests(self.links.fleet)
        self.picture_requests = make_picture_requests(
            self.links, settings, journal=self.journal, poses=self.poses, events=self.events,
            missing=lambda: self.coverage.document["missing_pictures"], add_picture=self.add_picture,
        )  # fmt: skip
        self.terrain = [] if settings.dem is None else [TerrainData(settings.dem, self.links.fleet)]
        self.tak = TakFeed([settings.tak_address(text) for text in settings.tak], self.exports.places)
        self.gap_flights = GapFlights(self.coverage, self.plans, self.links, self.takeoffs.rows)

    def _open_sources(self) -> None:
        """Where pictures and poses come from beside the links: folders, videos, CAN buses."""
        settings, folder = self.settings, self.settings.workspace
        self.sources = [
            Source(
                v.id, v.pictures, take=self.add_picture, pose_at=self.poses.at, notify=self._say,
                cache=folder / "videos", link_log=self._link_log, on_settled=self._card_read,
            )
            for v in settings.vehicles if v.pictures
        ]  # fmt: skip
        self.buses = [
            CanReader(
                v.id, v.can, poses=self.poses.of(v.id), notify=self._say, fleet=self.links.fleet,
                system=v.system or system_in_name(v.id),
            )
            for v in settings.vehicles if v.can
        ]  # fmt: skip

    def start(self) -> None:
        """Start drawing and processing."""
        if self.drawer.area is not None:
            self._area_changed(self.drawer.area)
        self.drawer.start()
        self.jobs.start()
        threading.Thread(target=self.workers.warm_up, daemon=True).start()
        self._watch_what_came_before()
        self.leg_watch.start()
        self.coverage.start()
        parts: list[Part] = [self.links, *self.terrain, self.picture_requests, self.tak, *self.sources, *self.buses]
        for part in parts:
            part.start()

    def close(self) -> None:
        """Stop; unfinished work continues at the next start."""
        self.jobs.give_up()
        self._close_sources()
        for bus in self.buses:
            bus.close()
        self.leg_watch.close()
        self.tak.close()
        self.picture_requests.close()
        for terrain in self.terrain:
            terrain.close()
        self.takeoffs.close()
        self.links.close()
        self.workers.close()
        self.background.close()
        self.jobs.close()
        self.drawer.close()
        self.coverage.close()
        for layer in self.layers.values():
            layer.close()
        self.journal.remember("clean", True)
        self.journal.close()
        self._lock.close()

    def _close_sources(self) -> None:
        """Stop all sources at once; one that waits for a silent stream ends at its time-out and stores nothing."""
        for source in self.sources:
            source.stop()
        end = time.monotonic() + _SOURCES_S
        stuck = [source.vehicle for source in self.sources if not source.close(max(0.0, end - time.monotonic()))]
        if stuck:
            _log.info("the streams of %s did not end in time and are abandoned", ", ".join(stuck))

    def __enter__(self) -> "Daemon":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- pictures -------------------------------------------------------------------------------------------------

    def add_picture(self, pose: PostedPose, data: bytes) -> tuple[int, bool]:
        """Store a picture; when this returns, it is safe on the disk.

        Returns:
            The frame's number, and False if it existed already (the first one stays).

        Raises:
            InputError: the file is not a picture.
            OrthoSwarmError: the disk is full or missing; nothing was stored.
        """
        came = time.time()
        key = frame_key(pose.vehicle, pose.image)
        known = self.journal.one("SELECT seq, path FROM frames WHERE key = ?", (key,))
        if known is not None:
            if not self.store.holds(known["path"], data):
                self.refused.note_name_taken(pose.vehicle, pose.image)
            return int(known["seq"]), False
        width, height, suffix = picture_size(data)
        pose = self._with_fix(pose)
        require_space(self.settings.workspace, len(data))
        time_s = came if pose.time_s is None else pose.time_s
        path = self.store.put(key, suffix, data)
        values = pose.values | ({"origin": pose.origin} if pose.origin else {})
        change = add_frame(key, pose.vehicle, pose.image, time_s=time_s, path=path, size=(width, height), pose=values)
        seq, new = self.journal.write(change)
        if new:
            frame = frame_of(
                values, image=pose.image, path=self.store.path(path), vehicle=pose.vehicle, time_s=time_s,
                size=(width, height),
            )  # fmt: skip
            sortie = self.sortie(pose.vehicle)
            self.posted[pose.vehicle] += 1
            self.drawer.add(seq, frame, came, sortie)
            if pose.has_fix:
                self.leg_watch.add(pose.vehicle, sortie, time_s, frame.fix.lat_deg, frame.fix.lon_deg)
            if self.posted[pose.vehicle] == _FEW:
                self.workers.warm_kernels()
                self.background.warm_up()
        return seq, new

    def _with_fix(self, pose: PostedPose) -> PostedPose:
        """The pose; if its receiver had no fix, with the values of the vehicle's link at that time."""
        if pose.has_fix or pose.time_s is None:
            return pose
        linked = linked_pose(pose.vehicle, pose.image, pose.time_s, self.poses.at(pose.vehicle, pose.time_s))
        if linked is None:
            return pose
        without = {k: v for k, v in pose.values.items() if k not in ("lat_deg", "lon_deg", "gps_fix")}
        return replace(linked, values=linked.values | without, origin=linked.origin | pose.origin)

    def sortie(self, vehicle: str) -> int:
        """The vehicle's present sortie."""
        row = self.journal.one("SELECT sortie FROM vehicles WHERE id = ?", (packed(vehicle),))
        return 1 if row is None else int(row["sortie"])

    def frames(
        self, vehicle: str | None = None, since: float | None = None, limit: int | None = None
    ) -> list[dict[str, Any]]:
        """Frames in the order of arrival, as JSON values; see the HTTP API."""
        return views.frame_rows(self.journal, vehicle, since, limit)

    def vehicles(self) -> list[dict[str, Any]]:
        """All vehicles that were heard or that sent pictures, as JSON values."""
        linked = {row["id"]: row for row in self.links.rows()}
        return views.vehicle_rows(
            self.journal, self.settings.vehicles, self.sources, linked, buses=self.buses, origins=self.poses.origins()
        )

    def legs(self) -> dict[str, Any]:
        """The legs as GeoJSON lines with state, confidence, sigma and stage (coarse: in flight)."""
        return views.leg_features(self.journal)

    def completions(self) -> list[dict[str, Any]]:
        """Completions of vehicles and their results."""
        return completion_rows(self.journal)

    def _link_log(self, vehicle: str, out: Path) -> bool:
        """Write a vehicle's packets on the links, of this and earlier runs, into its own log."""
        from gcs_plugin.links.tlog_writer import write_link_log

        systems = {v.id: v.system for v in self.settings.vehicles}
        system = systems.get(vehicle) or system_in_name(vehicle)
        return system is not None and write_link_log(self.settings.workspace / "telemetry.tlog", system, out) > 0

    def _say(self, text: str) -> None:
        _log.info("%s", text)
        self.events.publish("note", text=text)

    # -- layers ---------------------------------------------------------------------------------------------------

    def layer_rows(self) -> list[dict[str, Any]]:
        """The layers as JSON values, the basemap first."""
        return views.layer_rows(self.layers, self.tiles.basemap)

    def _anchor(self) -> Anchor | None:
        """The location of the map before the first picture: the basemap, else the newest plan."""
        basemap = self.tiles.basemap
        if basemap is not None:
            return Anchor.of_ground("the basemap", basemap.epsg, basemap.bounds)
        found = self.plans.newest_bounds()
        return None if found is None else Anchor("the newest plan", found)

    def _area_changed(self, area: Area) -> None:
        """Read the basemap on the area's grid."""
        basemap = self.tiles.basemap
        if self.settings.basemap is not None and (basemap is None or basemap.epsg != area.epsg):
            self.tiles.basemap = Basemap.open(self.settings.basemap, area.epsg)

    def _published(self, layer: str, job: Job) -> None:
        version = self.layers[layer].version
        self.events.publish("layer", layer=layer, version=version, vehicle=job.vehicle, sortie=job.sortie)
        self.coverage.look()

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

    def _card_read(self, vehicle: str) -> None:
        """A memory card was read after landing: a sortie that was complete before is refined with its pictures."""
        self._refine_late(vehicle, self.sortie(vehicle))

    def _refine_late(self, vehicle: str, sortie: int) -> None:
        """Register pictures that arrived after their vehicle's refinement (over a slow link) to the others."""
        waits = self.journal.one(
            "SELECT 1 FROM jobs WHERE kind = 'refine' AND vehicle = ? AND sortie = ? AND state = 'queued'",
            (packed(vehicle), sortie),
        )
        if waits is None and late_frames(self.journal, vehicle, sortie):
            self.jobs.add("refine", vehicle, sortie, trigger="late")

    def _leg_over(self, vehicle: str, sortie: int, silent: bool) -> None:
        """A leg is finished: queue its pictures for the coarse layer, at low priority."""
        complete = self.journal.one(
            "SELECT 1 FROM completions WHERE vehicle = ? AND sortie = ?", (packed(vehicle), sortie)
        )
        if self.settings.coarse and complete is None:
            self.jobs.add("coarse", vehicle, sortie, **({"over": True} if silent else {}))

    def _watch_what_came_before(self) -> None:
        """Queue pictures that the last daemon left unprocessed."""
        for row in self.journal.rows("SELECT DISTINCT vehicle, sortie FROM completions"):
            self._refine_late(unpacked(row["vehicle"]), int(row["sortie"]))
        rows = self.journal.rows(
            "SELECT vehicle, sortie, time, arrived, pose FROM frames WHERE stage = 'realtime' AND reason IS NULL"
            " AND NOT EXISTS (SELECT 1 FROM completions c WHERE c.vehicle = frames.vehicle"
            " AND c.sortie = frames.sortie) ORDER BY seq DESC LIMIT 2000"
        )
        for row in rows:
            pose = json.loads(row["pose"])
            time_s = row["arrived"] if row["time"] is None else row["time"]
            self.leg_watch.add(unpacked(row["vehicle"]), int(row["sortie"]), time_s, pose["lat_deg"], pose["lon_deg"])

    def _make_way(self, vehicle: str, layer: str | None) -> None:
        """A refinement begins or needs a layer: background jobs give way."""
        self.together.give_up()
        self.tones.give_up()
        if layer is None:
            self.jobs.drop("coarse", vehicle, _REPLACED)
        self.coarse.give_up(None, layer)

    def _after_job(self, job: Job) -> None:
        """Record the result of a completion; export the products again once nothing is left to refine."""
        if job.kind == "refine":
            self._note_refined(job)
            self.jobs.wake()
        elif job.kind not in ("together", "tones", "redraw") and (job.kind != "coarse" or "after" not in job.detail):
            return
        if not self.jobs.open("refine", "together", "tones", "coarse", "redraw"):
            self.jobs.add("export", formats=list(PRODUCTS), after="all")

    def _note_refined(self, job: Job) -> None:
        if job.state != "done" or job.vehicle is None or "published_s" not in job.detail or "beside" in job.detail:
            return
        facts = {
            "refine_started_s": job.detail["refine_started_s"], "refine_ended_s": job.detail["published_s"],
            "layer": job.detail["layer"], "version_before": job.detail["version_before"],
            "version": job.detail["version"], "frames": job.detail["frames"],
            "still_flying_after": [r["id"] for r in self.links.rows() if r["mission"]["phase"] == "active"],
        }  # fmt: skip
        self.journal.write(note_completion(job.vehicle, job.sortie, facts))
        self.events.publish("completion", vehicle=job.vehicle, sortie=job.sortie, **facts)

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

    def _facts(self) -> dict[str, Any]:
        """The daemon's own facts for the report."""
        return facts_of(
            [j.document() for j in self.jobs.all()], self.completions(), time.time() - self.started,
            cpu_s=time.process_time(), others=(self.workers.usage(), self.background.usage()), rss_mb=peak_rss_mb(),
        ) | ({} if self.coverage.document["state"] == "no area" else {"coverage": self.coverage.document})  # fmt: skip

    # -- health ---------------------------------------------------------------------------------------------------

    def problems(self) -> list[str]:
        """The present problems, in words."""
        own = (self.drawer.problem, self.drawer.overload, self.jobs.problem, self.tak.problem)
        linked = self.links.fleet.problems(self.links.name_of)
        return [text for text in (*own, *linked, *self.refused.problems(), *(s.problem for s in self.sources)) if text]

    def _rejected(self, frame: Frame, reason: str, misplaced: bool) -> None:
        """Report a stored picture that cannot be on the map."""
        self.refused.note("place" if misplaced else "map", reason, frame.vehicle, frame.image)

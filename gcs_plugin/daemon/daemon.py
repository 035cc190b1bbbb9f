"""The daemon without its web server: opens the workspace, puts its parts together, starts and ends them.

Parts are made in an order in which each needs only those before it. What happens later they tell each other by events;
`_subscribe` is the table of who hears what.
"""

import contextlib
import logging
import math
import os
import threading
import time
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.airspace import TerrainData
from gcs_plugin.daemon.exports import Exports, GroundChanges, TakFeed
from gcs_plugin.daemon.flight_coverage.exposure_journal import MESSAGES as EVENT_MESSAGES
from gcs_plugin.daemon.flight_coverage.exposure_journal import EventRequests, ExposureJournal
from gcs_plugin.daemon.flight_coverage.live_coverage import LiveCoverage
from gcs_plugin.daemon.flight_coverage.picture_requests import FetchedPictures, PictureRequests
from gcs_plugin.daemon.flight_coverage.picture_views import PictureViews
from gcs_plugin.daemon.intake.can_reader import CanReader
from gcs_plugin.daemon.intake.picture_intake import PictureIntake, RefusedPictures, VehicleIntake
from gcs_plugin.daemon.intake.picture_sources import PictureSource
from gcs_plugin.daemon.jobs.job_queue import JobRequests, Jobs, LegWatch
from gcs_plugin.daemon.jobs.leg_placement import LegPlacement
from gcs_plugin.daemon.jobs.neighbours import JointRefinement, ToneBalance
from gcs_plugin.daemon.jobs.publisher import Publisher
from gcs_plugin.daemon.jobs.sortie_refinement import SortieRefinement
from gcs_plugin.daemon.jobs.worker_pool import LAST, GettingReady, WorkerPool
from gcs_plugin.daemon.jobs.workspace_products import RunFacts
from gcs_plugin.daemon.layers.layers import NAMES, MapLayer
from gcs_plugin.daemon.layers.map_site import ExpectedPlace, MapSite
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.layers.web_tiles import TileServer
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store import daemon_events as happened
from gcs_plugin.daemon.store.console_state import ConsoleState
from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.journal import Journal, all_changes, drawn_forgotten, fact_change, statement
from gcs_plugin.daemon.store.people_rows import People, Pilots
from gcs_plugin.daemon.store.picture_store import KeptPictures, PictureStore
from gcs_plugin.daemon.survey_points import SurveyPoints
from gcs_plugin.daemon.takeoffs import Takeoffs
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.daemon.views import Views
from gcs_plugin.daemon.web_plans import GapFlights, Plans
from orthoswarm.batch.workspace import Workspace
from orthoswarm.compute.workers import prepare_process
from orthoswarm.model.errors import InputError
from telemetry.live.live_poses import LinkPoses

_FEW: Final = 10  # posted pictures of a vehicle, after which the process for background jobs is started
_SOURCES_S: Final = 1.0
_LOCK_S: Final = 5.0
_log = logging.getLogger(__name__)


class Daemon:
    """All of the daemon but HTTP, which calls its parts; `started`: when, UTC epoch seconds."""

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
        with contextlib.ExitStack() as undone:
            undone.callback(self._lock.close)
            self._open_records()
            self._open_vehicles()
            undone.callback(self.links.fleet.close)
            self._open_pictures()
            self._open_jobs()
            self._subscribe()
            if self.drawer.area is not None:
                self.events.publish(happened.AreaChanged(self.drawer.area.epsg))
            undone.pop_all()

    def _open_records(self) -> None:
        """What is kept in the workspace."""
        settings, folder = self.settings, self.settings.workspace
        self.journal = Journal(folder / "journal.db")
        self.store = PictureStore(folder / "pictures")
        self.layers = {name: MapLayer(name) for name in NAMES}
        self._trusted = distrust_after_power_cut(self.journal)
        self.tiles = TileServer(self.layers, settings.basemap)
        self.refused = RefusedPictures(self.events)
        self.console = ConsoleState(self.journal, self.events)
        self.people = People(self.journal, self.events)
        self.pilots = Pilots(self.people, self.events, self.journal)

    def _open_vehicles(self) -> None:
        """The vehicles on their links, and their takeoffs."""
        settings = self.settings
        self.poses = LinkPoses()
        self.links = VehicleLinks(settings, self.journal, self.events, self.poses)
        fleet = self.links.fleet
        self.plans = Plans(settings.workspace / "plans", settings.dem, self.links, settings.config)
        self.takeoffs = Takeoffs(self.links, self.plans, self.events.say)
        self.exposures = ExposureJournal(self.journal, self.links.names)
        fleet.subscribe(self.exposures.message, *EVENT_MESSAGES)
        EventRequests(fleet)
        self.terrain = [] if settings.dem is None else [TerrainData(settings.dem, fleet)]

    def _open_pictures(self) -> None:
        """Pictures and poses as they come, the map that grows in flight, and how well the area is seen."""
        settings, folder = self.settings, self.settings.workspace
        systems = settings.systems()
        self.intake = PictureIntake(self.journal, self.store, self.events, poses=self.poses, refused=self.refused)
        taken: dict[str, Any] = {
            "intake": self.intake, "events": self.events, "poses": self.poses, "tlog": folder / "telemetry.tlog",
            "cache": folder / "videos",
        }  # fmt: skip
        self.sources = [
            PictureSource(v.pictures, VehicleIntake(v.id, system=systems.get(v.id), **taken))
            for v in settings.vehicles if v.pictures
        ]  # fmt: skip
        self.buses = [
            CanReader(
                v.id, v.can, poses=self.poses.of(v.id), events=self.events, fleet=self.links.fleet,
                system=systems.get(v.id),
            )
            for v in settings.vehicles if v.can
        ]  # fmt: skip
        self.views = Views(
            self.journal, self.links, tiles=self.tiles, sources=self.sources, buses=self.buses, poses=self.poses,
            solutions=folder / "solutions",
        )  # fmt: skip
        canvases = folder / "layers"
        canvases.mkdir(exist_ok=True)
        fov_rad = None if settings.fov_min_deg is None else math.radians(settings.fov_min_deg)
        site = MapSite(
            self.journal, self.layers["realtime"], canvases, gsd_m=settings.gsd_m, fov_rad=fov_rad,
            expected=ExpectedPlace(self.tiles, self.plans.newest_bounds), events=self.events,
            memory_mb=settings.config.compute.live_canvas_mb,
        )  # fmt: skip
        live = settings.basemap if settings.coarse else None
        self.drawer = Drawer(self.journal, self.store, site, self.events, basemap=live)
        self.leg_watch = LegWatch(self.events, silent_s=settings.silent_s)
        self.coverage = LiveCoverage(
            self.journal, self.events, views=PictureViews(self.journal, self.store, folder / "solutions", fov_rad),
            console=self.console, plans=self.plans.folder, drawer=self.drawer,
            on_links=lambda: self.links.latest, exposures=self.exposures,
        )  # fmt: skip
        self.gap_flights = GapFlights(self.coverage, self.plans, self.links)
        fetched = FetchedPictures(
            self.journal, self.events, poses=self.poses, coverage=self.coverage, intake=self.intake
        )
        self.picture_requests = PictureRequests(
            self.links.fleet, fetched, folder=settings.picture_folder, most_bytes_s=settings.picture_bytes_s
        )

    def _open_jobs(self) -> None:
        """What refines, publishes and exports in the background, and what a stop left undone of it."""
        settings = self.settings
        self.workers, self.background = WorkerPool(settings.workers), WorkerPool(1, LAST)
        config, folder = settings.config, settings.workspace
        publisher = Publisher(
            self.journal, self.layers, folder, drawer=self.drawer, events=self.events, basemap=settings.basemap,
            device=config.matchers.device, trusted=self._trusted,
        )  # fmt: skip
        kept = KeptPictures(folder / "kept", config.raster.grey_pictures_mb)
        refinement = SortieRefinement(publisher, self.store, kept, self.drawer)
        facts = RunFacts(self.journal, self.started, (self.workers, self.background))
        self.exports = Exports(
            settings, self.journal, store=self.store, layers=self.layers, console=self.console, drawer=self.drawer,
            views=self.views, coverage=self.coverage, facts=facts, people=self.people,
        )  # fmt: skip
        self.points = SurveyPoints(self.journal, self.events, self.exports)
        self.changes = GroundChanges(settings, self.journal, self.store)
        self.getting_ready = GettingReady(self.events)
        self.tak = TakFeed([settings.tak_address(text) for text in settings.tak], self.exports)
        handlers = {
            "refine": refinement.refine, "coarse": LegPlacement(publisher, self.store, kept, self.events).make,
            "together": JointRefinement(publisher, settings.redraw_px).solve, "tones": ToneBalance(publisher).balance,
            "export": self.exports.write, "redraw": publisher.draw_again, "change": self.changes.find,
        }  # fmt: skip
        self.jobs = Jobs(self.journal, self.events, handlers, self.workers, self.background)
        self.requests = JobRequests(
            self.journal, self.jobs, coarse=settings.coarse, basemap=settings.basemap is not None
        )
        if publisher.lost:
            self.jobs.add("redraw")
        for whose in publisher.outdated:
            self.jobs.add("refine", *whose)

    def _subscribe(self) -> None:
        """Who hears what, in this order, in the thread of the part that tells it."""
        on = self.events.on
        on(happened.PictureStored, self.drawer.picture_stored)  # told by: PictureIntake
        on(happened.PictureStored, self.leg_watch.picture_stored)
        on(happened.PictureStored, self._warm_up)
        on(happened.PictureDrawn, self.coverage.picture_drawn)  # Drawer
        on(happened.PictureRejected, self.refused.picture_rejected)
        on(happened.AreaChanged, self.tiles.area_changed)  # MapSite
        on(happened.DrawingRestarted, self.drawer.draw_anew)
        on(happened.FirstPicturesCame, self.requests.first_pictures_came)  # Drawer
        on(happened.VehicleLookedFor, self.drawer.vehicle_looked_for)  # LegPlacement
        on(happened.LegsOver, self.requests.legs_over)  # LegWatch
        on(happened.VehicleSilent, self.requests.vehicle_silent)
        on(happened.CardRead, self.requests.card_read)  # VehicleIntake
        on(happened.MissionNoted, self.requests.mission_noted)  # VehicleLinks
        on(happened.LayerPublished, self.coverage.look)  # Publisher
        on(happened.JobEnded, self.links.job_ended)  # Jobs
        on(happened.JobEnded, self.requests.job_ended)

    def _warm_up(self, event: happened.PictureStored) -> None:
        """Start the process of what is done in the background, as a vehicle is soon to be looked for on the map."""
        if event.count == _FEW:
            self.background.warm_up()

    def start(self) -> None:
        """Start drawing and processing."""
        self.drawer.start()
        self.jobs.start()
        self.getting_ready.start()
        threading.Thread(target=self.workers.warm_up, daemon=True).start()
        self.requests.continue_last(self.leg_watch)
        self.links.start()
        for part in (self.leg_watch, self.coverage, *self.terrain, self.picture_requests, self.tak, *self.buses):
            part.start()
        for source in self.sources:
            source.start()

    def close(self) -> None:
        """Stop; unfinished work continues at the next start."""
        self.jobs.give_up()
        self.getting_ready.close()
        self._close_sources()
        for background in (*self.buses, self.leg_watch, self.tak, self.picture_requests, *self.terrain):
            background.close()
        for part in (self.takeoffs, self.links, self.workers, self.background, self.jobs, self.drawer, self.coverage):
            part.close()
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

    def problems(self) -> list[str]:
        """The present problems, in words."""
        own = (self.drawer.problem, self.drawer.overload, self.jobs.problem, self.tak.problem)
        inputs = (*self.links.fleet.problems(), *self.refused.problems(), *(s.problem for s in self.sources))
        return [text for text in (self.getting_ready.problem, *own, *inputs) if text]


def take_over(workspace: Path) -> Workspace:
    """Take the workspace's lock, waiting for a daemon that is just ending.

    The folder becomes accessible to its owner only, as it contains the token, pictures, and positions.

    Raises:
        InputError: another daemon holds it.
    """
    end = time.monotonic() + _LOCK_S
    while True:
        try:
            lock = Workspace(workspace)
            with contextlib.suppress(OSError):  # another user's folder, or a file system without permissions
                workspace.chmod(0o700)
            return lock
        except InputError:
            if workspace.is_file() or time.monotonic() > end:
                raise
            time.sleep(0.1)


def distrust_after_power_cut(journal: Journal) -> bool:
    """After a power cut, have the real-time layer drawn again, as its last pixels may be lost.

    Pictures and journal are synced before they are acknowledged, solution files before they are published; canvases are
    not, for speed.

    Returns:
        Whether canvases can be trusted.
    """
    boot = _boot_id()
    clean = bool(journal.fact("clean") or journal.fact("boot") in (None, boot))
    forgotten = () if clean else (drawn_forgotten, statement("DELETE FROM meta WHERE key = 'realtime'", ()))
    journal.write(all_changes(fact_change("boot", boot), fact_change("clean", False), *forgotten))
    if not clean:
        _log.warning("the machine was switched off without a shutdown; the real-time layer is drawn again")
    return clean


def _boot_id() -> str:
    """Identifies this boot of the machine."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return str(round((time.time() - time.monotonic()) / 60.0)) if os.name == "nt" else ""

"""Pictures that vehicles have taken and that have not arrived are read from them over MAVLink FTP, in the background.

A picture is found by the name that its camera event gives (`file_url` of CAMERA_IMAGE_CAPTURED, mftp://), else by the
number in its file's name: that of the event, shifted as the pictures that have arrived show. What is not found for
certain is not read. While a command or a mission is under way with any vehicle nothing is asked for.
"""

import contextlib
import logging
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final
from urllib.parse import unquote, urlsplit

import numpy as np

from gcs_plugin.daemon.flight_coverage.file_download import FileRead, FolderList, FtpTalk, LinkShare
from gcs_plugin.daemon.flight_coverage.live_coverage import LiveCoverage, MissingRow
from gcs_plugin.daemon.intake.picture_intake import PictureIntake
from gcs_plugin.daemon.intake.posted_pose import PostedPose, linked_pose
from gcs_plugin.daemon.stoppable_thread import Background
from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.frame_rows import dated_images, exposure_place, exposure_times, pose_near
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.file_transfer import payload_of
from orthoswarm.model.errors import InputError, OrthoSwarmError
from telemetry.live.live_poses import LinkPoses

_SURE: Final = 0.9  # share of the pictures that agree on the shift of numbers
_LEAST: Final = 3  # pictures for it
_PICTURES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
_EVENT: Final = "camera event"
_STEP_S, _LOOK_S = 0.02, 1.0
_AGAIN_S: Final = 60.0
_LIST_AGAIN_S, _LIST_AT_LEAST_S = 10.0, 600.0
_QUIET_S: Final = 1.0
_TELL_S: Final = 2.0
_MOST_URLS: Final = 20_000  # of one camera's list
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class PictureNames:
    """The pictures of a vehicle that have arrived.

    Attributes:
        images: their names. shift: number of a file less that of its camera event; None if there is no such number.
    """

    images: set[str] = field(default_factory=set)
    shift: int | None = 0

    @staticmethod
    def of(pictures: Iterable[tuple[str, float]], events: Iterable[tuple[int, float]]) -> "PictureNames":
        """From arrived pictures (name, UTC seconds) and camera events (number, UTC seconds).

        Each picture belongs to the event nearest in time, within half of the usual time between events. The shift is
        0 while fewer than three pictures have arrived, and None if the differences of the numbers vary.
        """
        arrived, exposed = list(pictures), sorted(events, key=lambda event: event[1])
        images = {image for image, _ in arrived}
        times = np.array([time_s for _, time_s in exposed])
        if len(times) < 2:
            return PictureNames(images)
        slack_s = 0.5 * float(np.median(np.diff(times)))
        shifts: Counter[int] = Counter()
        for image, time_s in arrived:
            nearest = int(np.abs(times - time_s).argmin())
            number = number_of(image)
            if number is not None and abs(times[nearest] - time_s) <= slack_s:
                shifts[number - exposed[nearest][0]] += 1
        if shifts.total() < _LEAST:
            return PictureNames(images)
        shift, count = shifts.most_common(1)[0]
        return PictureNames(images, shift if count >= _SURE * shifts.total() else None)

    def find(self, number: int, files: Mapping[str, int]) -> tuple[str, str]:
        """The path of an event's picture among a vehicle's files, and why there is none ("" where there is one)."""
        if self.shift is None:
            return "", "the numbers of its files do not match those of its camera events"
        pictures = [path for path in files if path.lower().endswith(_PICTURES)]
        if self.images:
            forms = {_form(image) for image in self.images}
            same_form = [path for path in pictures if _form(path) in forms]
            if pictures and not same_form:
                return "", "its files have other names than the pictures that have arrived"
            pictures = same_form
        found = [path for path in pictures if number_of(path) == number + self.shift]
        arrived = {path.rpartition("/")[0] for path in files if path.rpartition("/")[2] in self.images}
        same = [path for path in found if path.rpartition("/")[0] in arrived]
        found = same or found
        if len(found) > 1:
            return "", f"several of its files have number {number + self.shift}"
        return (found[0], "") if found else ("", f"it has no picture file with number {number + self.shift}")


def _form(name: str) -> str:
    """A name without its numbers: `img_#.jpg`."""
    return re.sub(r"\d+", "#", name.rpartition("/")[2].lower())


def number_of(name: str) -> int | None:
    """The last number in a file's name."""
    digits = re.findall(r"\d+", name.rpartition("/")[2])
    return int(digits[-1]) if digits else None


@dataclass(frozen=True, slots=True)
class WantedPicture:
    """A picture that has not arrived: its vehicle's id, the number of its camera event, UTC epoch seconds."""

    vehicle: str
    number: int
    time_s: float


@dataclass(slots=True, kw_only=True)
class _Request:
    """A wanted picture. `state`: waiting, asked, arrived, refused; `path`: on the vehicle, once it is known.

    `listing`: the number of the vehicle's listing in which it was not found.
    """

    wanted: WantedPicture
    state: str = "waiting"
    reason: str = ""
    path: str = ""
    listing: int = -1
    read: FileRead | None = None

    def row(self) -> dict[str, Any]:
        return {
            "vehicle": self.wanted.vehicle, "number": self.wanted.number, "state": self.state, "reason": self.reason,
            "image": self.path.rpartition("/")[2],
            "percent": 100 if self.state == "arrived" else 0 if self.read is None else int(100 * self.read.share),
        }  # fmt: skip


@dataclass(slots=True, kw_only=True)
class _Server:
    """A vehicle's files. `not_before`: when it may be asked again, after it did not answer."""

    component: int = 1
    files: dict[str, int] | None = None
    listed_at: float = 0.0
    listings: int = 0
    not_before: float = 0.0
    urls: dict[int, str] = field(default_factory=dict)


class FetchedPictures:
    """What the requests for pictures need of the workspace."""

    def __init__(
        self, journal: Journal, events: Events, *, poses: LinkPoses, coverage: LiveCoverage,
        intake: PictureIntake,
    ) -> None:  # fmt: skip
        self._journal, self._events = journal, events
        self._poses, self._coverage, self._intake = poses, coverage, intake

    def wanted(self) -> Iterable[WantedPicture]:
        """The pictures that were taken and have not arrived."""
        return wanted_pictures(self._coverage.result.document["missing_pictures"])

    def names(self, vehicle: str) -> PictureNames:
        """The names of a vehicle's pictures that have arrived, and how their numbers match its camera events."""
        return PictureNames.of(dated_images(self._journal, vehicle), exposure_times(self._journal, vehicle))

    def store(self, wanted: WantedPicture, name: str, data: bytes) -> None:
        """Store a picture with the pose of its link, else with that of its camera event.

        Raises:
            InputError: it is no picture, or neither pose is known. OrthoSwarmError: the disk is full or missing.
        """
        linked = linked_pose(self._poses, wanted.vehicle, name, wanted.time_s)
        self._intake.add(linked or self._event_pose(wanted, name), data)

    def changed(self) -> None:
        """Tell the pages that a request's state has changed."""
        self._events.tell("requests")

    def _event_pose(self, wanted: WantedPicture, name: str) -> PostedPose:
        """The position of a camera event, with height and angles of the vehicle's picture nearest in time.

        For pictures that the links' poses, which go back some minutes, do not reach.
        """
        place = exposure_place(self._journal, wanted.vehicle, wanted.number, wanted.time_s)
        if place is None:
            raise InputError("its camera event has no position, and the link's are too old")
        near = pose_near(self._journal, wanted.vehicle, wanted.time_s)
        values = {k: v for k, v in near.items() if k not in ("origin", "damaged", "gps_fix")}
        values |= {"lat_deg": place[0], "lon_deg": place[1]}
        return PostedPose(wanted.vehicle, name, wanted.time_s, values, {"position": _EVENT, "time": _EVENT})


class PictureRequests(Background):
    """Asks vehicles for their pictures.

    Args:
        fleet: the vehicles. workspace: see there.
        folder: of the pictures on the vehicles. most_bytes_s: most of all links together, bytes a second; 0: none.
        clock: monotonic seconds, the fleet's.
    """

    def __init__(
        self,
        fleet: Fleet,
        workspace: FetchedPictures,
        *,
        folder: str = "/DCIM",
        most_bytes_s: float = 30_000.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__("picture requests")
        self._fleet, self._workspace, self._folder, self._clock = fleet, workspace, folder, clock
        self._on = most_bytes_s > 0.0
        self._share = LinkShare(max(1.0, most_bytes_s))
        self._requests: dict[tuple[str, int], _Request] = {}
        self._servers: dict[int, _Server] = {}
        self._talk: FtpTalk | None = None
        self._reading: _Request | None = None
        self._stepped = self._busy_at = -_QUIET_S
        self._told_at = 0.0
        fleet.subscribe(self._answered, "FILE_TRANSFER_PROTOCOL")
        fleet.subscribe(self._captured, "CAMERA_IMAGE_CAPTURED")

    def start(self) -> None:
        """Start the thread. A picture that is being read when it stops is read anew after the next start."""
        if self._on:
            super().start()

    def rows(self) -> list[dict[str, Any]]:
        """All requests as JSON values, by vehicle and number: `state`, `reason`, `percent`, `image`."""
        return [request.row() for _, request in sorted(self._requests.items(), key=lambda item: item[0])]

    # -- its own thread -------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stop.wait(_STEP_S if self._talk is not None else _LOOK_S):
            try:
                self.work()
                self._fleet.call(self.step).result(5.0)
                if self._reading is not None and time.monotonic() - self._told_at > _TELL_S:
                    self._told_at = time.monotonic()
                    self._workspace.changed()
            except TimeoutError:
                continue
            except Exception as error:  # an odd answer must not end it
                _log.warning("asking for pictures: %s", error)
                self._stop.wait(_LOOK_S)

    def work(self) -> None:
        """Store what was read, and choose what to read next; not in the links' thread."""
        talk = self._talk
        if talk is not None and not talk.over:
            return
        if talk is not None:
            self._finish(talk)
        self._look()
        self._begin()

    def _finish(self, talk: FtpTalk) -> None:
        self._talk, request, self._reading = None, self._reading, None
        server, job, now = self._servers[talk.system], talk.job, self._clock()
        if talk.silent:
            server.not_before = now + _AGAIN_S
            if request is None:
                self._refuse_all(talk.system, "the vehicle does not answer over MAVLink FTP; it is asked again")
            else:
                request.state, request.reason = (
                    "waiting",
                    "the vehicle has stopped answering; the rest is asked for later",
                )
        elif request is None and isinstance(job, FolderList):
            server.files, server.listed_at, server.listings = job.files, now, server.listings + 1
            if job.refused:
                server.not_before = now + _AGAIN_S
                self._refuse_all(talk.system, f"not available from the vehicle: {job.refused}")
        elif request is not None and job.refused:
            request.state, request.reason, request.read = "refused", job.refused, None
        elif request is not None and isinstance(job, FileRead):
            self._store_arrived(request, job.content)
        self._workspace.changed()

    def _store_arrived(self, request: _Request, content: bytes) -> None:
        try:
            self._workspace.store(request.wanted, request.path.rpartition("/")[2], content)
        except InputError as error:
            request.state, request.reason = "refused", str(error)
        except OrthoSwarmError as error:  # the disk is full: it is read again when there is room
            request.state, request.reason = "waiting", str(error)
            self._servers[self._fleet.system_of(request.wanted.vehicle)].not_before = self._clock() + _AGAIN_S
        else:
            request.state, request.reason = "arrived", ""
        request.read = None

    def _look(self) -> None:
        """Take over what is wanted by now; what is not wanted any more has come some other way."""
        wanted = {(w.vehicle, w.number): w for w in self._workspace.wanted()}
        changed = False
        for key in wanted.keys() - self._requests.keys():
            self._requests[key] = _Request(wanted=wanted[key])
            changed = True
        for key in [k for k, r in self._requests.items() if k not in wanted and r.state in ("waiting", "refused")]:
            del self._requests[key]
            changed = True
        if changed:
            self._workspace.changed()

    def _begin(self) -> None:
        """Begin to read the oldest waiting picture of a vehicle that can be asked, or first the folder with it."""
        now, known = self._clock(), dict[str, PictureNames]()
        waiting = [r for r in self._requests.values() if r.state in ("waiting", "refused")]
        for request in sorted(waiting, key=lambda r: (r.state, r.wanted.time_s)):
            try:
                system = self._fleet.system_of(request.wanted.vehicle)
            except OrthoSwarmError:
                continue
            server = self._servers.setdefault(system, _Server())
            if now < server.not_before or self._fleet.vehicles[system].lost:
                continue
            if not self._find(request, server, known):
                pause_s = min(_LIST_AGAIN_S * 2.0 ** min(server.listings, 9), _LIST_AT_LEAST_S)
                if server.files is None or now - server.listed_at > pause_s:
                    self._converse(FolderList(self._folder), system, server, None)
                    return
                continue
            if request.state == "waiting":
                request.read = request.read or FileRead(request.path)
                request.state, request.reason = "asked", ""
                self._converse(request.read, system, server, request)
                self._workspace.changed()
                return

    def _find(self, request: _Request, server: _Server, known: dict[str, PictureNames]) -> bool:
        """Set the path of a request's file, or why there is none; returns whether the path is known.

        `known`: names of the pictures that have arrived, by vehicle, as far as they were needed.
        """
        number, vehicle = request.wanted.number, request.wanted.vehicle
        path, reason = server.urls.get(number, ""), ""
        if not path:
            if server.files is None or request.listing == server.listings:
                return False
            if vehicle not in known:
                known[vehicle] = self._workspace.names(vehicle)
            path, reason = known[vehicle].find(number, server.files)
        if path:
            if request.path != path:  # the vehicle has it by now
                request.path, request.state, request.read = path, "waiting", None
            return True
        request.listing = server.listings
        if (request.state, request.reason) != ("refused", reason):
            request.state, request.reason = "refused", reason
            self._workspace.changed()
        return False

    def _converse(self, job: FileRead | FolderList, system: int, server: _Server, request: _Request | None) -> None:
        self._reading = request
        self._talk = FtpTalk(
            job=job, system=system, component=server.component, share=self._share, send=self._fleet.send,
            began=self._clock(),
        )  # fmt: skip

    def _refuse_all(self, system: int, reason: str) -> None:
        """All waiting requests to a vehicle are refused for one reason; they are tried again later."""
        for request in self._requests.values():
            with contextlib.suppress(OrthoSwarmError):
                if request.state == "waiting" and self._fleet.system_of(request.wanted.vehicle) == system:
                    request.state, request.reason, request.path = "refused", reason, ""
        self._servers[system].files = None

    # -- in the links' thread ---------------------------------------------------------------------------------------

    def step(self) -> None:
        """Ask for more of what is being read, unless a command or a mission is under way."""
        now = self._clock()
        since, self._stepped = now - self._stepped, now
        talk = self._talk
        if talk is None:
            return
        if any(self._fleet.busy(system) for system in self._fleet.vehicles):
            self._busy_at = now
        if now - self._busy_at < _QUIET_S:
            talk.pause(min(since, _LOOK_S))
            return
        talk.step(now)

    def _answered(self, vehicle: Vehicle, message: Any, _: float) -> None:
        talk, answer = self._talk, payload_of(message)
        if talk is None or answer is None or vehicle.system != talk.system:
            return
        if message.target_system == self._fleet.own.system:
            talk.answer(answer, self._clock())

    def _captured(self, vehicle: Vehicle, message: Any, _: float) -> None:
        server = self._servers.setdefault(vehicle.system, _Server())
        server.component = int(message.get_srcComponent())
        url = message.file_url
        parts = urlsplit((url.decode("utf-8", "replace") if isinstance(url, bytes) else str(url)).rstrip("\0"))
        if parts.scheme == "mftp" and parts.path and len(server.urls) < _MOST_URLS:
            server.urls[int(message.image_index)] = unquote(parts.path)


def wanted_pictures(missing: Iterable[MissingRow]) -> list[WantedPicture]:
    """Those of the coverage's missing pictures that were taken and have not arrived."""
    return [
        WantedPicture(row["vehicle"], int(row["image"].removeprefix("event ")), row["time_s"])
        for row in missing
        if row["image"].startswith("event ") and row["time_s"] is not None
    ]

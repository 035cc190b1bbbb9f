"""All pictures come into the workspace here: posted, from streams, from folders, and fetched from vehicles.

Those that were refused, dropped or left off the map are counted by cause; recent ones are problems.
"""

import logging
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.intake.posted_pose import PostedPose, frame_of, linked_pose
from gcs_plugin.daemon.store.daemon_events import Events, PictureRejected, PictureStored
from gcs_plugin.daemon.store.frame_rows import add_frame, frame_by_key
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.picture_store import PictureStore, frame_key, picture_size
from gcs_plugin.daemon.store.sortie_rows import present_sortie
from gcs_plugin.links.tlog_writer import write_link_log
from orthoswarm.export.product_files import iso_time
from orthoswarm.model.errors import OrthoSwarmError, StorageError
from orthoswarm.model.frame import UNSTATED_SIGMA_M
from telemetry.live.live_poses import LinkPoses
from telemetry.samples.held_fixes import FixNews

CAUSES: Final = {
    "disk": "the workspace's disk is full or gone",
    "pose": "the pose is wrong or missing",
    "picture": "the file is not a picture, or too large",
    "time": "the upload stood still",
    "name": "another picture of the vehicle has the name",
    "place": "the picture's position cannot be on the map",
    "map": "the picture cannot be drawn",
}
_NEWS_S: Final = 600.0


@dataclass(slots=True)
class _Refusals:
    count: int
    vehicle: str
    image: str
    reason: str
    time_s: float


class RefusedPictures:
    """Counts them since the daemon's start; any thread; `events`: told of each. `clock`: UTC epoch seconds."""

    def __init__(self, events: Events, clock: Callable[[], float] = time.time) -> None:
        self._events, self._clock = events, clock
        self._lock = threading.Lock()
        self._by_cause: dict[str, _Refusals] = {}

    def note(self, cause: str, reason: str, vehicle: str = "", image: str = "") -> None:
        """Count one; `cause`: one of CAUSES. `reason`: in a sentence. `vehicle, image`: as far as known."""
        with self._lock:
            before = self._by_cause.get(cause)
            count = 1 if before is None else before.count + 1
            self._by_cause[cause] = _Refusals(count, vehicle, image, reason, self._clock())
        self._events.tell("refused", cause=cause, count=count, vehicle=vehicle, image=image, reason=reason)

    def picture_rejected(self, event: PictureRejected) -> None:
        """Count a stored picture that cannot be on the map."""
        self.note("place" if event.misplaced else "map", event.reason, event.frame.vehicle, event.frame.image)

    def note_name_taken(self, vehicle: str, image: str) -> None:
        """Count a picture whose name another one of the vehicle has; the first one stays."""
        text = f"{vehicle} sent another picture by a name that it used before"
        self.note("name", f"{text}; have its camera or computer count on, and send it again", vehicle, image)

    @property
    def counts(self) -> dict[str, int]:
        """Cause -> how many; every cause is there."""
        with self._lock:
            return {cause: self._by_cause[cause].count if cause in self._by_cause else 0 for cause in CAUSES}

    def rows(self) -> list[dict[str, Any]]:
        """A row per cause with `cause`, `text`, `count` and the last one's `vehicle`, `image`, `reason`, `time`."""
        with self._lock:
            return [
                {
                    "cause": cause, "text": CAUSES[cause], "count": r.count, "vehicle": r.vehicle, "image": r.image,
                    "reason": r.reason, "time": iso_time(r.time_s),
                }
                for cause, r in self._by_cause.items()
            ]  # fmt: skip

    def problems(self) -> list[str]:
        """A sentence for each cause of the last ten minutes."""
        now = self._clock()
        with self._lock:
            recent = [r for r in self._by_cause.values() if now - r.time_s < _NEWS_S]
        return [f"{r.count} picture{'s' * (r.count > 1)} refused or not on the map: {r.reason}" for r in recent]


_FULL_S: Final = 2.0
_log = logging.getLogger(__name__)


class PictureIntake:
    """Stores pictures, and tells of each new one once it is safe.

    Args:
        store: its folder lies in the workspace. poses: of the links and buses. refused: counts names used twice.

    Attributes:
        accepted: how many came since the daemon's start, by vehicle.
    """

    def __init__(
        self, journal: Journal, store: PictureStore, events: Events, *, poses: LinkPoses, refused: RefusedPictures
    ) -> None:
        self._journal, self._store, self._events = journal, store, events
        self._poses, self._refused = poses, refused
        self._news: defaultdict[str, FixNews] = defaultdict(FixNews)
        self.accepted: Counter[str] = Counter()

    def add(self, pose: PostedPose, data: bytes) -> tuple[int, bool]:
        """Store a picture; when this returns, it is safe on the disk.

        Returns:
            The frame's number, and False if it existed already (the first one stays).

        Raises:
            InputError: the file is not a picture.
            OrthoSwarmError: the disk is full or missing; nothing was stored.
        """
        came = time.time()
        key = frame_key(pose.vehicle, pose.image)
        known = frame_by_key(self._journal, key)
        if known is not None:
            if not self._store.holds(known[1], data):
                self._refused.note_name_taken(pose.vehicle, pose.image)
            return known[0], False
        width, height, suffix = picture_size(data)
        time_s = came if pose.time_s is None else pose.time_s
        pose = self._with_fix(self._aged(pose, time_s))
        self._store.require_space(len(data))
        path, size = self._store.put(key, suffix, data), (width, height)
        values = pose.values | ({"origin": pose.origin} if pose.origin else {})
        change = add_frame(key, pose.vehicle, pose.image, time_s=time_s, path=path, size=size, pose=values)
        seq, new = self._journal.write(change)
        if new:
            frame = frame_of(
                values, image=pose.image, path=self._store.path(path), vehicle=pose.vehicle, time_s=time_s, size=size
            )
            self.accepted[pose.vehicle] += 1
            sortie, count = present_sortie(self._journal, pose.vehicle), self.accepted[pose.vehicle]
            self._events.publish(PictureStored(
                seq=seq, frame=frame, arrived_s=came, sortie=sortie, has_fix=pose.has_fix, count=count
            ))  # fmt: skip
        return seq, new

    def _aged(self, pose: PostedPose, time_s: float) -> PostedPose:
        """The pose, with how far the vehicle may have flown since its receiver had news."""
        if pose.by_link or not pose.has_fix:
            return pose
        held_m = self._news[pose.vehicle].hear(time_s, (pose.values["lat_deg"], pose.values["lon_deg"]), None)
        return replace(pose, values=pose.values | {"held_m": held_m}) if held_m > UNSTATED_SIGMA_M else pose

    def _with_fix(self, pose: PostedPose) -> PostedPose:
        """The pose; if its receiver had no fix, with the values of the vehicle's link at that time."""
        linked = None if pose.has_fix else linked_pose(self._poses, pose.vehicle, pose.image, pose.time_s)
        if linked is None:
            return pose
        without = {k: v for k, v in pose.values.items() if k not in ("lat_deg", "lon_deg", "gps_fix", "held_m")}
        return replace(linked, values=linked.values | without, origin=linked.origin | pose.origin)


class VehicleIntake:
    """One vehicle's pictures on their way into the workspace, from a stream or a folder.

    Args:
        system: its MAVLink system id, None without. intake: takes the pictures.
        poses, tlog: where pictures without a pose get theirs from; the log of all links may be absent.
        cache: folder of the workspace for the folder's state, and for pictures of videos until they are stored.

    Attributes:
        stop: set to end. taken: number of pictures that were new.
    """

    def __init__(
        self,
        vehicle: str,
        intake: PictureIntake,
        events: Events,
        *,
        poses: LinkPoses,
        tlog: Path,
        system: int | None,
        cache: Path,
    ) -> None:
        self.vehicle, self.cache, self.stop, self.taken = vehicle, cache, threading.Event(), 0
        self.events, self.poses, self._intake, self._tlog, self._system = events, poses, intake, tlog, system

    def keep(self, pose: PostedPose, data: bytes) -> None:
        """Store a picture; if the disk is full, wait until there is room."""
        while not self.stop.is_set():
            try:
                _, new = self._intake.add(pose, data)
                self.taken += new
                return
            except StorageError as error:
                self.events.say(str(error))
                self.stop.wait(_FULL_S)
            except OrthoSwarmError as error:
                _log.warning("%s of %s: %s", pose.image, self.vehicle, error)
                return

    def link_log(self, out: Path) -> bool:
        """Write the vehicle's packets, of this run and earlier ones, to a .tlog; False if there are none."""
        return self._system is not None and write_link_log(self._tlog, self._system, out) > 0

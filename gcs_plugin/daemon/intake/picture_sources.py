"""Sources of a vehicle's pictures besides HTTP: a live stream, or a folder that receives files (`watched_folder`)."""

import logging
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.daemon.intake.posted_pose import PostedPose, pose_values
from gcs_plugin.daemon.intake.watched_folder import FolderReader, PictureIntake
from orthoswarm.model.errors import OrthoSwarmError, StorageError
from telemetry.live.live_poses import LinkPose
from telemetry.samples.sample import Sample

if TYPE_CHECKING:
    from telemetry.live.live_stream import LivePicture

_SILENT_S: Final = 20.0  # triggered cameras are silent in the vehicle's turns
_SCHEMES: Final = ("rtsp://", "rtsps://", "rtmp://", "udp://", "tcp://", "srt://", "http://", "https://")
STREAM_THREAD: Final = "pictures of "
_log = logging.getLogger(__name__)

PoseAt = Callable[[str, float], LinkPose | None]
Take = Callable[[PostedPose, bytes], tuple[int, bool]]
LinkLog = Callable[[str, Path], bool]


def is_stream(where: str) -> bool:
    """True for an address of a live stream, False for a folder."""
    return where.lower().startswith(_SCHEMES)


class Source:
    """Pictures of one vehicle, read in its own thread.

    Args:
        vehicle: id.
        where: stream or folder.
        take: stores a picture.
        pose_at: returns the vehicle's pose at a time from its link and bus, for pictures without their own.
        notify: called with messages for the user.
        cache: folder for pictures of videos and for the states of folders.
        on_settled: called with the vehicle when its folder has stopped changing after new pictures.
        link_log: writes a vehicle's packets into a .tlog; returns False if there are none.
    """

    def __init__(
        self, vehicle: str, where: str, *, take: Take, pose_at: PoseAt, notify: Callable[[str], None], cache: Path,
        link_log: LinkLog = lambda vehicle, out: False, on_settled: Callable[[str], None] = lambda vehicle: None,
    ) -> None:  # fmt: skip
        self.vehicle, self.where = vehicle, where
        self._take, self._pose_at, self._notify = take, pose_at, notify
        self._stop = threading.Event()
        self._state, self.taken, self._without_pose = "waiting", 0, 0
        self._reader: FolderReader | None = None
        if not is_stream(where):
            intake = PictureIntake(
                vehicle=vehicle,
                keep=self._store,
                pose_at=partial(pose_at, vehicle),
                link_log=partial(link_log, vehicle),
                notify=notify,
                on_settled=partial(on_settled, vehicle),
                cache=cache,
                stop=self._stop,
            )
            self._reader = FolderReader(Path(where), intake)
        run = self._stream if self._reader is None else self._reader.run
        self._thread = threading.Thread(target=self._guarded, args=(run,), name=STREAM_THREAD + vehicle, daemon=True)

    @property
    def state(self) -> str:
        """Its state, in words."""
        return self._state if self._reader is None or self._state.startswith("failed") else self._reader.state

    @property
    def without_pose(self) -> int:
        """Number of stream pictures dropped, or of files waiting, for lack of a pose."""
        return self._without_pose if self._reader is None else len(self._reader.poseless)

    @property
    def problem(self) -> str:
        """What is wrong at present, in words; empty if nothing is."""
        count = self.without_pose
        return f"{count} pictures of {self.vehicle} have no pose; put the flight's log next to them" if count else ""

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> None:
        """Ask it to stop; a wait inside a stream's library ends later."""
        self._stop.set()

    def close(self, wait_s: float = 5.0) -> bool:
        """Stop reading; returns whether it ended within the time-out."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(wait_s)
        return not self._thread.is_alive()

    def document(self) -> dict[str, Any]:
        """Its state as JSON values, without addresses, which may contain passwords."""
        return {
            "kind": "stream" if is_stream(self.where) else "folder", "state": self.state, "taken": self.taken,
            "without_pose": self.without_pose,
        }  # fmt: skip

    def _guarded(self, run: Callable[[], None]) -> None:
        while not self._stop.is_set():
            try:
                self._state = "waiting"
                run()
                return
            except Exception:  # a broken stream must not end the thread
                _log.exception("the pictures of %s", self.vehicle)
                self._state = "failed, tried again"
                self._stop.wait(2.0)

    # -- a stream -------------------------------------------------------------------------------------------------

    def _stream(self) -> None:
        from telemetry.live.live_stream import open_stream
        from telemetry.videos.extraction import encode_jpeg

        def state(text: str) -> None:
            before, self._state = self._state, text.split(":")[0]
            if self._state != before:  # every attempt fails while a camera sends nothing on the ground
                self._notify(f"the pictures of {self.vehicle}: {self._state}")

        for picture in open_stream(self.where, stop=self._stop, on_state=state, timeout_s=_SILENT_S):
            self._offer(picture, partial(encode_jpeg, picture.rgb))

    def _offer(self, picture: "LivePicture", data: Callable[[], bytes]) -> None:
        """Store a picture with its own pose, gaps filled from the vehicle's link and bus."""
        name, time_s, origin = f"live-{picture.time_s:.3f}.jpg", picture.time_s, picture.origin
        own = picture.sample if picture.sample is not None else Sample()
        recorded = {"position": own.lat_deg, "height": own.height_m, "angles": own.yaw_deg}
        origins = dict.fromkeys((key for key, value in recorded.items() if value is not None), origin)
        if not own.has_position or own.yaw_deg is None or own.height_m is None:
            linked = self._pose_at(self.vehicle, time_s)
            if linked is not None:
                own, origins = own.merge(linked.sample), linked.origin | origins
        values = pose_values(own)
        if values is None:
            self._without_pose += 1
            return
        if picture.damaged:
            values["damaged"] = True
        self._store(PostedPose(self.vehicle, name, time_s, values, origins), data())

    def _store(self, pose: PostedPose, data: bytes) -> None:
        """Store a picture; if the disk is full, wait until there is room."""
        while not self._stop.is_set():
            try:
                _, new = self._take(pose, data)
                self.taken += new
                return
            except StorageError as error:
                self._notify(str(error))
                self._stop.wait(2.0)
            except OrthoSwarmError as error:
                _log.warning("%s of %s: %s", pose.image, self.vehicle, error)
                return

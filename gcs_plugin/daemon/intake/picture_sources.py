"""Sources of a vehicle's pictures besides HTTP: a live stream, or a folder that receives files (`watched_folder`)."""

import logging
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.daemon.intake.picture_intake import VehicleIntake
from gcs_plugin.daemon.intake.posted_pose import PostedPose, pose_values
from gcs_plugin.daemon.intake.watched_folder import FolderReader
from telemetry.samples.sample import Sample

if TYPE_CHECKING:
    from telemetry.live.live_stream import LivePicture

_SILENT_S: Final = 20.0  # triggered cameras are silent in the vehicle's turns
_SCHEMES: Final = ("rtsp://", "rtsps://", "rtmp://", "udp://", "tcp://", "srt://", "http://", "https://")
STREAM_THREAD: Final = "pictures of "
_log = logging.getLogger(__name__)


def is_stream(where: str) -> bool:
    """True for an address of a live stream, False for a folder."""
    return where.lower().startswith(_SCHEMES)


class PictureSource:
    """Pictures of one vehicle, read in its own thread."""

    def __init__(self, where: str, intake: VehicleIntake) -> None:
        self.vehicle, self.where, self._intake = intake.vehicle, where, intake
        self._state, self._without_pose = "waiting", 0
        self._reader = None if is_stream(where) else FolderReader(Path(where), intake)
        self._thread = threading.Thread(target=self._guarded, name=STREAM_THREAD + self.vehicle, daemon=True)

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
        self._intake.stop.set()

    def close(self, wait_s: float = 5.0) -> bool:
        """Stop reading; returns whether it ended within the time-out."""
        self._intake.stop.set()
        if self._thread.ident is not None:
            self._thread.join(wait_s)
        return not self._thread.is_alive()

    def document(self) -> dict[str, Any]:
        """Its state as JSON values, without addresses, which may contain passwords."""
        return {
            "kind": "stream" if is_stream(self.where) else "folder", "state": self.state, "taken": self._intake.taken,
            "without_pose": self.without_pose,
        }  # fmt: skip

    def _guarded(self) -> None:
        stop = self._intake.stop
        while not stop.is_set():
            try:
                self._state = "waiting"
                (self._stream if self._reader is None else self._reader.run)()
                return
            except Exception:  # a broken stream must not end the thread
                _log.exception("the pictures of %s", self.vehicle)
                self._state = "failed, tried again"
                stop.wait(2.0)

    # -- a stream -------------------------------------------------------------------------------------------------

    def _stream(self) -> None:
        from telemetry.live.live_stream import open_stream
        from telemetry.videos.extraction import encode_jpeg

        def state(text: str) -> None:
            before, self._state = self._state, text.split(":")[0]
            if self._state != before:  # every attempt fails while a camera sends nothing on the ground
                self._intake.events.say(f"the pictures of {self.vehicle}: {self._state}")

        for picture in open_stream(self.where, stop=self._intake.stop, on_state=state, timeout_s=_SILENT_S):
            pose = self._pose(picture)
            if pose is None:
                self._without_pose += 1
            else:
                self._intake.keep(pose, encode_jpeg(picture.rgb))

    def _pose(self, picture: "LivePicture") -> PostedPose | None:
        """A picture's own pose, with gaps filled from the vehicle's link and bus; None if its place is not known."""
        name, time_s, origin = f"live-{picture.time_s:.3f}.jpg", picture.time_s, picture.origin
        own = picture.sample if picture.sample is not None else Sample()
        recorded = {"position": own.lat_deg, "height": own.height_m, "angles": own.yaw_deg}
        origins = dict.fromkeys((key for key, value in recorded.items() if value is not None), origin)
        if not own.has_position or own.yaw_deg is None or own.height_m is None:
            linked = self._intake.poses.at(self.vehicle, time_s)
            if linked is not None:
                own, origins = own.merge(linked.sample), linked.origin | origins
        values = pose_values(own)
        if values is None:
            return None
        if picture.damaged:
            values["damaged"] = True
        return PostedPose(self.vehicle, name, time_s, values, origins)

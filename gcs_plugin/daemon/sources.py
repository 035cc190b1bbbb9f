"""Where a vehicle's pictures come from besides HTTP: a live stream, or a folder into which files arrive."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.pose import PostedPose
from orthoswarm.errors import OrthoSwarmError
from orthoswarm.frame import Fix, Frame
from telemetry.sample import Sample

_POLL_S: Final = 0.5
_QUIET_S: Final = 1.0
_SILENT_S: Final = 20.0  # cameras that send at a vehicle's triggers are silent in its turns
_SCHEMES: Final = ("rtsp://", "rtsps://", "rtmp://", "udp://", "tcp://", "srt://", "http://", "https://")
_HIDDEN_SUFFIXES: Final = (".part", ".tmp", ".crdownload")
_log = logging.getLogger(__name__)

PoseAt = Callable[[str, float], Sample | None]
Take = Callable[[PostedPose, bytes], tuple[int, bool]]


def is_stream(where: str) -> bool:
    """True for an address of a live stream, False for a folder."""
    return where.lower().startswith(_SCHEMES)


class Source:
    """Pictures of one vehicle, read in a thread of its own.

    Args:
        vehicle: id.
        where: stream or folder.
        take: takes a picture in.
        pose_at: the vehicle's pose at a moment from its link, for pictures without one of their own.
        tell: told what happens, in words.
        cache: folder for pictures of videos.
    """

    def __init__(
        self, vehicle: str, where: str, take: Take, pose_at: PoseAt, tell: Callable[[str], None], cache: Path
    ) -> None:
        self.vehicle, self.where = vehicle, where
        self._take, self._pose_at, self._tell, self._cache = take, pose_at, tell, cache
        self._stop = threading.Event()
        self.state, self.taken, self.without_pose = "waiting", 0, 0
        run = self._stream if is_stream(where) else self._folder
        self._thread = threading.Thread(target=self._guarded, args=(run,), name=f"pictures of {vehicle}", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Stop reading."""
        self._stop.set()
        self._thread.join(5.0)

    def document(self) -> dict[str, Any]:
        """Its state as JSON values; addresses are not told, they may hold passwords."""
        return {
            "kind": "stream" if is_stream(self.where) else "folder", "state": self.state, "taken": self.taken,
            "without_pose": self.without_pose,
        }  # fmt: skip

    def _guarded(self, run: Callable[[], None]) -> None:
        while not self._stop.is_set():
            try:
                run()
                return
            except Exception:  # whatever a strange stream does, the vehicle's next picture counts
                _log.exception("the pictures of %s", self.vehicle)
                self.state = "failed, tried again"
                self._stop.wait(2.0)

    # -- a stream -------------------------------------------------------------------------------------------------

    def _stream(self) -> None:
        from telemetry.extract import encode_jpeg
        from telemetry.stream import open_stream

        def state(text: str) -> None:
            self.state = text.split(":")[0]
            self._tell(f"the pictures of {self.vehicle}: {self.state}")

        for picture in open_stream(self.where, stop=self._stop, on_state=state, timeout_s=_SILENT_S):
            if picture.damaged:
                continue
            name = f"live-{picture.time_s:.3f}.jpg"
            self._offer(name, picture.time_s, picture.sample, partial(encode_jpeg, picture.rgb))

    def _offer(self, name: str, time_s: float, sample: Sample | None, data: Callable[[], bytes]) -> None:
        """Take a picture with the pose that it carries, gaps filled from the vehicle's link."""
        own = sample if sample is not None else Sample()
        if not own.has_position or own.yaw_deg is None or own.height_m is None:
            linked = self._pose_at(self.vehicle, time_s)
            own = own if linked is None else own.merge(linked)
        values = pose_values(own)
        if values is None:
            self.without_pose += 1
            return
        self._keep(PostedPose(self.vehicle, name, time_s, values), data())

    def _keep(self, pose: PostedPose, data: bytes) -> None:
        """Take a picture in; with the disk full, wait until there is room."""
        while not self._stop.is_set():
            try:
                _, new = self._take(pose, data)
                self.taken += new
                return
            except OrthoSwarmError as error:
                if "disk" not in str(error) and "journal" not in str(error):
                    _log.warning("%s of %s: %s", pose.image, self.vehicle, error)
                    return
                self._tell(str(error))
                self._stop.wait(2.0)

    # -- a folder -------------------------------------------------------------------------------------------------

    def _folder(self) -> None:
        from orthoswarm.picture import PICTURE_SUFFIXES
        from telemetry.discover import VIDEO_SUFFIXES

        folder = Path(self.where)
        known: dict[Path, tuple[int, int]] = {}
        changed: dict[Path, float] = {}
        while not self._stop.wait(_POLL_S):
            self.state = "watching" if folder.is_dir() else "the folder is not there"
            for path in sorted(folder.rglob("*")) if folder.is_dir() else []:
                suffix = path.suffix.lower()
                if suffix not in PICTURE_SUFFIXES | VIDEO_SUFFIXES or path.name.startswith("."):
                    continue
                try:
                    stat = path.stat()
                except OSError:
                    continue
                stamp, now = (stat.st_size, stat.st_mtime_ns), time.monotonic()
                if known.get(path) != stamp:  # new, or still being written
                    known[path], changed[path] = stamp, now
                elif path in changed and now - changed[path] > _QUIET_S and stat.st_size > 0:
                    del changed[path]
                    self._file(path, path.relative_to(folder).as_posix())

    def _file(self, path: Path, name: str) -> None:
        """Take in a photo, or the pictures of a video, that has arrived whole."""
        import telemetry

        try:
            found = telemetry.load([path], options=telemetry.LoadOptions(cache=self._cache, workers=1))
        except OrthoSwarmError as error:
            _log.warning("%s: %s", name, error)
            return
        for frame in found.frames:
            if self._stop.is_set():
                return
            _, mark, number = frame.image.partition("#")
            self._keep(_posted(frame, self.vehicle, name + mark + number), frame.path.read_bytes())
        for rejection in found.rejected:
            if rejection.time_s is not None and "#" not in rejection.image:
                self._offer(name, rejection.time_s, None, path.read_bytes)
            else:
                self.without_pose += 1
                _log.warning("%s: %s", name, rejection.reason)


def pose_values(sample: Sample) -> dict[str, float] | None:
    """What the journal keeps of a sample; None without a position."""
    if not sample.has_position:
        return None
    names = ("lat_deg", "lon_deg", "height_m", "altitude_m", "yaw_deg", "pitch_deg", "roll_deg", "flight_yaw_deg")
    values = {n: float(v) for n in (*names, "fov_deg") if (v := getattr(sample, n)) is not None}
    if sample.sigma_m is not None:
        values["position_sigma_m"] = float(sample.sigma_m)
    if sample.height_is_ground:
        values["height_is_ground"] = True
    return values


def _posted(frame: Frame, vehicle: str, name: str) -> PostedPose:
    """A frame of a file as if it had been posted."""
    import math

    values: dict[str, float] = {}
    for entry in fields(Fix):
        value = getattr(frame.fix, entry.name)
        if value is not None and value is not False:
            degrees = entry.name.endswith("_rad")
            key = entry.name.removesuffix("_rad") + "_deg" if degrees else entry.name
            values[key] = math.degrees(value) if degrees else float(value)
    if frame.fov_hint_rad is not None:
        values["fov_deg"] = math.degrees(frame.fov_hint_rad)
    return PostedPose(vehicle, name, frame.time_s, values)

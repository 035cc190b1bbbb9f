"""Watches a folder that receives a vehicle's photos and videos, over a network or from a memory card.

A file is read when it is complete (`is_complete`, by the end of its data) and has not changed between two scans. Files
read are remembered in the workspace, so that after a restart, or for a known card, only the names are compared.
Pictures without a pose of their own get it from the vehicle's link, or from a log, subtitles or table in the folder.
"""

import contextlib
import hashlib
import json
import logging
import os
import shutil
import struct
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gcs_plugin.daemon.intake.picture_intake import VehicleIntake
from gcs_plugin.daemon.intake.posted_pose import apart_m, linked_pose, posted_frame
from gcs_plugin.daemon.store.daemon_events import CardRead
from orthoswarm.model.errors import OrthoSwarmError

if TYPE_CHECKING:
    from orthoswarm.model.frame import Frame, Ingest, Rejection

_SOI: Final = b"\xff\xd8"
_SOS: Final = 0xDA
_EOI: Final = b"\xff\xd9"
_BARE: Final = frozenset({0x01, *range(0xD0, 0xD8)})
"""JPEG markers without a length."""
_POLL_S: Final = 0.25
_SCAN_SHARE: Final = 0.1  # of the time that looking at the folder may take
_QUIET_S: Final = 1.0
_SETTLED_S: Final = 3.0
_BATCH: Final = 32  # pictures that are handed over at a time
_BATCH_BYTES: Final = 64 << 20
_STALLED_S: Final = 30.0
_UNCHANGED_S: Final = 2.0
_REST_S: Final = 5.0
_AGAIN_S: Final = (20.0, 600.0)
_NEAR_M: Final = 50.0
_log = logging.getLogger(__name__)
_HEAD: Final = 1 << 20  # bytes at either end that identify a file
Stamp = tuple[int, int]
"""Size of a file and time of its last change, nanoseconds."""


def is_complete(data: bytes, suffix: str) -> bool:
    """Whether a picture's bytes are complete; True for formats in which this is unknown.

    A stalled copy, or one whose reserved space is still zeros, is not complete.

    Args:
        data: the file's bytes so far. suffix: of its name, with the dot.
    """
    kind = suffix.lower()
    if kind in (".jpg", ".jpeg"):
        return _jpeg(data)
    if kind == ".png":
        return b"IEND\xaeB`\x82" in data[-64:]
    if kind == ".webp":
        return len(data) >= 12 and len(data) >= 8 + int(struct.unpack_from("<I", data, 4)[0])
    if kind == ".bmp":
        return len(data) >= 6 and len(data) >= int(struct.unpack_from("<I", data, 2)[0])
    return _opens(data)


def _jpeg(data: bytes) -> bool:
    """Whether the main picture's end of image is there (ITU-T T.81, B.1): thumbnails in APP segments end earlier."""
    if not data.startswith(_SOI):
        return len(data) > 4  # not a JPEG: its reader reports that
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return False
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker in _BARE:
            at += 2
        elif marker == _SOS:
            return data.find(_EOI, at) >= 0
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _opens(data: bytes) -> bool:
    """Whether a picture of another kind (TIFF) can be decoded to its last row."""
    import io

    from PIL import Image

    from orthoswarm.raster.picture_file import PictureError, picture_size

    try:
        picture_size(data)
    except PictureError:
        return len(data) > 64  # not a picture, or too large: its reader reports that
    try:
        with Image.open(io.BytesIO(data)) as picture:
            picture.load()
    except (OSError, ValueError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError):
        return False
    return True


def is_video_complete(path: Path) -> bool:
    """Whether an MP4 or MOV contains all its boxes, including the index; True for other formats.

    Raises:
        OSError: the file cannot be read.
    """
    if path.suffix.lower() not in (".mp4", ".mov", ".m4v"):
        return True
    size, at, index = path.stat().st_size, 0, False
    with path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16)
            length, kind = int.from_bytes(head[:4], "big"), head[4:8]
            if at == 0 and kind not in (b"ftyp", b"moov", b"mdat", b"free", b"wide", b"skip", b"styp"):
                return True  # not such a file
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            index |= kind in (b"moov", b"moof")
            if length == 0:  # to the end of the file
                return index or kind == b"moov"
            if length < 8:
                return False
            at += length
    return index and at <= size


class FolderState:
    """The files read from a folder, listed in a file of the workspace; started afresh for another journal."""

    def __init__(self, cache: Path, vehicle: str, folder: Path) -> None:
        key = hashlib.sha256(json.dumps([vehicle, str(folder)]).encode()).hexdigest()[:16]
        self._path = cache / f"taken-{key}.jsonl"
        self._stamps: dict[str, Stamp] = {}
        self._digests: dict[str, list[str]] = {}
        journal = _identity(cache.parent / "journal.db")
        lines: list[str] = []
        with contextlib.suppress(OSError, UnicodeDecodeError):
            lines = self._path.read_text(encoding="utf-8").splitlines()
        if lines and lines[0] == journal:
            for line in lines[1:]:
                with contextlib.suppress(ValueError, TypeError, KeyError):  # incomplete after a power cut
                    name, size, changed, digest = json.loads(line)
                    self._note(name, (size, changed), digest)
        else:
            with contextlib.suppress(OSError):
                cache.mkdir(parents=True, exist_ok=True)
                self._path.write_text(journal + "\n", encoding="utf-8")

    def same(self, name: str, stamp: Stamp) -> bool:
        """Whether a file was read in its present state, by size and modification time."""
        return self._stamps.get(name) == stamp

    def holds(self, name: str, digest: str) -> bool:
        """Whether this content was stored under this name."""
        return digest in self._digests.get(name, ())

    def name(self, name: str, digest: str) -> str:
        """The name to store a file under: a different one if another picture has its name (a reformatted card)."""
        if not self._digests.get(name) or self.holds(name, digest):
            return name
        stem, suffix = os.path.splitext(name)
        return f"{stem}~{digest[:8]}{suffix}"

    def add(self, name: str, stamp: Stamp, digest: str) -> None:
        """Remember a file whose pictures are all stored."""
        self._note(name, stamp, digest)
        with contextlib.suppress(OSError), self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([name, *stamp, digest]) + "\n")

    def _note(self, name: str, stamp: Stamp, digest: str) -> None:
        self._stamps[name] = stamp
        if not self.holds(name, digest):
            self._digests.setdefault(name, []).append(digest)


def _identity(path: Path) -> str:
    try:
        stat = path.stat()
    except OSError:
        return "no journal"
    return f"journal {stat.st_dev} {stat.st_ino}"


def digest_of(data: bytes) -> str:
    """Digest of a content."""
    return hashlib.sha256(data).hexdigest()[:32]


def video_digest(path: Path) -> str:
    """Digest of a video's length, beginning and end."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEAD)
        file.seek(max(0, size - _HEAD))
        return digest_of(str(size).encode() + head + file.read(_HEAD))


@dataclass(slots=True)
class _File:
    """The last known state of a file.

    Attributes:
        stamp: size and modification time. since: when first seen in this state. done: True once it needs no more work.
        again_at: time of the next check of an incomplete file.
        stall_reported: True once the user was informed that it makes no progress.
    """

    stamp: Stamp
    since: float
    done: bool = False
    again_at: float = 0.0
    stall_reported: bool = False


class FolderReader:
    """Reads one folder.

    Args:
        folder: to watch, including subfolders; it may appear and disappear.

    Attributes:
        state: in words. poseless: files that wait for a pose.
    """

    def __init__(self, folder: Path, intake: VehicleIntake) -> None:
        from orthoswarm.raster.picture_file import PICTURE_SUFFIXES
        from telemetry.formats.log.flight_logs import LOG_SUFFIXES
        from telemetry.ingest.discovery import VIDEO_SUFFIXES

        self.folder, self._intake = folder, intake
        self.state = "waiting"
        self.poseless: set[Path] = set()
        self._pictures, self._videos = PICTURE_SUFFIXES, VIDEO_SUFFIXES
        self._wanted = PICTURE_SUFFIXES | VIDEO_SUFFIXES | LOG_SUFFIXES | {".srt", ".txt", ".csv"}
        self._files: dict[Path, _File] = {}
        self._folder_state = FolderState(intake.cache, intake.vehicle, folder)
        self._tried: object = None
        self._told: frozenset[Path] = frozenset()
        self._zone_told = False
        self._again_at, self._again_s = 0.0, _AGAIN_S[0]
        self._fresh_at: float | None = None

    def run(self) -> None:
        """Watch until told to stop."""
        wait = _POLL_S
        while not self._intake.stop.wait(wait):
            began = time.monotonic()
            self._look(began)
            wait = max(_POLL_S, min(5.0, (time.monotonic() - began) / _SCAN_SHARE if not self._busy() else 0.0))

    def _busy(self) -> bool:
        return any(not file.done and not file.stall_reported for file in self._files.values())

    # -- scanning -------------------------------------------------------------------------------------------------

    def _look(self, now: float) -> None:
        """Scan the folder once, and process the result."""
        if not self.folder.is_dir():
            self.state = "the folder is not there"
            return
        self.state = "watching"
        here: list[Path] = []
        for path, stamp in self._scan(self.folder):
            here.append(path)
            known = self._files.get(path)
            if known is None or known.stamp != stamp:  # new, or still being written
                done = known is None and self._folder_state.same(self._name(path), stamp)
                self._files[path] = _File(stamp, now, done)
        photos = [p for p in here if p.suffix.lower() in self._pictures and self._settled(p, now, _POLL_S)]
        for batch in self._batches(photos):
            if self._intake.stop.is_set():
                return
            self._take_photos(batch, now)
        for path in here:
            if path.suffix.lower() in self._videos and self._settled(path, now, _QUIET_S):
                self._take_video(path, now)
        self._pair(here, now)
        if self._fresh_at is not None and not self._busy() and now - self._fresh_at > _REST_S:
            self._fresh_at = None
            self._intake.events.publish(CardRead(self._intake.vehicle))

    def _scan(self, folder: Path) -> Iterator[tuple[Path, Stamp]]:
        """Files of the wanted kinds with their stamps, by name; unreadable ones are left for the next scan."""
        try:
            with os.scandir(folder) as entries:
                listed = sorted(entries, key=lambda entry: entry.name)
        except OSError:
            return
        for entry in listed:
            if entry.name.startswith("."):
                continue
            try:
                if entry.is_dir(follow_symlinks=False):
                    yield from self._scan(Path(entry.path))
                elif os.path.splitext(entry.name)[1].lower() in self._wanted:
                    stat = entry.stat()
                    if stat.st_size > 0:
                        yield Path(entry.path), (stat.st_size, stat.st_mtime_ns)
            except OSError:
                continue

    def _batches(self, photos: Sequence[Path]) -> Iterator[list[Path]]:
        """Batches of photos limited by memory."""
        batch: list[Path] = []
        size = 0
        for path in photos:
            if batch and (len(batch) >= _BATCH or size + self._files[path].stamp[0] > _BATCH_BYTES):
                yield batch
                batch, size = [], 0
            batch.append(path)
            size += self._files[path].stamp[0]
        if batch:
            yield batch

    def _settled(self, path: Path, now: float, quiet_s: float) -> bool:
        file = self._files[path]
        return not file.done and now - file.since >= quiet_s and now >= file.again_at

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()

    def _wait_for(self, path: Path, now: float) -> None:
        """Handle an incomplete file; after a while the user is told, once."""
        file = self._files[path]
        file.again_at = now + _UNCHANGED_S
        if now - file.since > _STALLED_S and not file.stall_reported:
            file.stall_reported = True
            self._intake.events.say(f"{self._name(path)} of {self._intake.vehicle} is incomplete; copy it again")

    # -- storing -----------------------------------------------------------------------------------------------

    def _take_photos(self, paths: Sequence[Path], now: float) -> None:
        """Store the complete photos of one scan together, as wrong angles are found by comparing neighbours."""
        complete: dict[Path, tuple[bytes, str]] = {}
        for path in paths:
            try:
                data = path.read_bytes()
            except OSError:  # gone again, or not readable yet
                self._wait_for(path, now)
                continue
            if not is_complete(data, path.suffix):
                self._wait_for(path, now)
                continue
            digest = digest_of(data)
            if self._folder_state.holds(self._name(path), digest):  # modification time changed, or on another card
                self._done(path, digest)
            else:
                complete[path] = data, digest
        if not complete:
            return
        asked = [*complete, *self._tables(complete)]
        found = self._load(asked)
        if found is None:
            asked = list(complete)
            found = self._load(asked)
        mine = {os.path.normpath(path.absolute()): path for path in complete}
        for frame in found.frames if found else []:
            if self._intake.stop.is_set():
                return
            photo = mine.get(os.path.normpath(frame.path))
            if photo is not None:
                data, digest = complete.pop(photo)
                self._keep(frame, self._folder_state.name(self._name(photo), digest), data)
                self._done(photo, digest)
        root = os.path.commonpath([path.parent.absolute() for path in asked])  # the root of relative names
        self._without(
            {os.path.normpath(os.path.join(root, r.image)): r for r in found.rejected} if found else {}, complete
        )

    def _without(self, rejected: "dict[str, Rejection]", left: dict[Path, tuple[bytes, str]]) -> None:
        """Handle photos that did not become frames; those without a position may still get one."""
        for path, (data, digest) in left.items():
            rejection = rejected.get(os.path.normpath(path.absolute()))
            self._files[path].done = True
            if rejection is None or not rejection.lacks_position:
                _log.warning(
                    "%s: %s", self._name(path), rejection.reason if rejection else "no picture can be read from it"
                )
                continue
            name = self._folder_state.name(self._name(path), digest)
            posted = linked_pose(self._intake.poses, self._intake.vehicle, name, rejection.time_s)
            if posted is None:
                self.poseless.add(path)
                continue
            self._intake.keep(posted, data)
            self._done(path, digest)

    def _take_video(self, path: Path, now: float) -> None:
        """Store the pictures of a video."""
        try:
            if not is_video_complete(path):
                self._wait_for(path, now)
                return
            digest = video_digest(path)
        except OSError:
            self._wait_for(path, now)
            return
        if self._folder_state.holds(self._name(path), digest):
            self._done(path, digest)
            return
        subtitles = [p for p in self._files if p.suffix.lower() == ".srt" and p.with_suffix("") == path.with_suffix("")]
        found = self._load([path, *subtitles])
        if found is None or not path.exists():
            self._files[path].done = found is None and path.exists()
            return
        self._keep_video(path, found, digest)

    def _keep_video(self, path: Path, found: "Ingest", digest: str) -> None:
        name = self._folder_state.name(self._name(path), digest)
        for frame in found.frames:
            if self._intake.stop.is_set():
                return
            self._keep(frame, f"{name}#{frame.image.partition('#')[2]}", frame.path.read_bytes())
            if frame.path.is_relative_to(self._intake.cache):
                frame.path.unlink(missing_ok=True)
        if found.frames:
            self._done(path, digest)
            return
        if any(rejection.lacks_position for rejection in found.rejected):
            self.poseless.add(path)
        for rejection in found.rejected:
            _log.warning("%s: %s", self._name(path), rejection.reason)
        self._files[path].done = True

    def _keep(self, frame: "Frame", name: str, data: bytes) -> None:
        """Store a frame; missing height and angles come from the link, if its position agrees."""
        posted = posted_frame(frame, self._intake.vehicle, name)
        if "height_m" not in posted.values or "yaw_deg" not in posted.values:
            linked = linked_pose(self._intake.poses, posted.vehicle, name, posted.time_s)
            if linked is not None and apart_m(linked.values, posted.values) < _NEAR_M:
                for key in ("lat_deg", "lon_deg", "position_sigma_m", "altitude_m"):
                    linked.values.pop(key, None)
                posted = replace(posted, values=linked.values | posted.values, origin=linked.origin | posted.origin)
        self._intake.keep(posted, data)

    def _done(self, path: Path, digest: str) -> None:
        file = self._files[path]
        file.done = True
        self.poseless.discard(path)
        self._fresh_at = time.monotonic()
        if not self._intake.stop.is_set():
            self._folder_state.add(self._name(path), file.stamp, digest)

    def _load(self, paths: Sequence[Path]) -> "Ingest | None":
        import telemetry

        try:
            found = telemetry.load(paths, options=telemetry.LoadOptions(cache=self._intake.cache, workers=1))
        except OrthoSwarmError as error:
            _log.warning("%s: %s", self._intake.vehicle, error)
            return None
        self._tell_zone(found.frames)
        return found

    def _tell_zone(self, frames: "Sequence[Frame]") -> None:
        """Tell the user once that times have no zone; the report counts them all."""
        from telemetry.photos.flight_checks import times_without_zone

        said = [] if self._zone_told else times_without_zone(frames)
        self._zone_told |= bool(said)
        for finding in said:
            self._intake.events.say(f"{self._intake.vehicle}: {finding}")

    def _tables(self, photos: Iterable[Path]) -> list[Path]:
        """Tables of poses (geo.txt, CSV) in the photos' folder or above it, within the watched folder."""
        above = {folder for photo in photos for folder in photo.parents if folder.is_relative_to(self.folder)}
        return [p for p in self._files if p.suffix.lower() in (".txt", ".csv") and p.parent in above and p.exists()]

    # -- poses from logs ------------------------------------------------------------------------------------------

    def _pair(self, here: Sequence[Path], now: float) -> None:
        """Assign pictures without poses those of a log in the folder or of the vehicle's link, all at once."""
        waiting = sorted(self.poseless.intersection(here))
        if not waiting or any(now - self._files[path].since < _SETTLED_S for path in here):
            return
        sides = [p for p in here if p.suffix.lower() not in self._pictures | self._videos]
        state = (tuple(waiting), tuple((p, self._files[p].stamp) for p in sides))
        if state != self._tried:
            self._again_s = _AGAIN_S[0]
        elif now < self._again_at:
            return
        self._tried, self._again_at = state, now + self._again_s
        self._again_s = min(_AGAIN_S[1], 2.0 * self._again_s)
        self._intake.cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="pairing-", dir=self._intake.cache) as name:
            copies = Path(name)
            for path in [*waiting, *sides]:
                _stand_in(path, copies / path.relative_to(self.folder))
            self._intake.link_log(copies / "link.tlog")
            found = self._load([copies])
            if found is not None:
                self._take_paired(waiting, found, copies)
        if self.poseless and self.poseless != self._told:
            self._told, count = frozenset(self.poseless), len(self.poseless)
            self._intake.events.say(
                f"{count} files of {self._intake.vehicle} wait for poses; put the flight's log next to them"
            )

    def _take_paired(self, waiting: Sequence[Path], found: "Ingest", intake: Path) -> None:
        frames: dict[str, list[Frame]] = {}
        for frame in found.frames:
            frames.setdefault(frame.image.partition("#")[0], []).append(frame)
        for path in waiting:
            mine = frames.get(self._name(path), [])
            with contextlib.suppress(OSError):  # gone meanwhile: left for the next scan
                if mine and "#" in mine[0].image:
                    self._keep_video(path, replace(found, frames=mine, rejected=[]), video_digest(path))
                elif mine:
                    data = path.read_bytes()
                    digest = digest_of(data)
                    self._keep(mine[0], self._folder_state.name(self._name(path), digest), data)
                    self._done(path, digest)


def _stand_in(path: Path, place: Path) -> None:
    """Make a file available in another folder, by a link where possible, else by a copy."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        place.symlink_to(path.absolute())
    except OSError:
        try:
            os.link(path, place)
        except OSError:
            shutil.copy2(path, place)

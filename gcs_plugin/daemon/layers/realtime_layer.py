"""The real-time layer: one thread draws all undrawn frames of the journal, the most useful first.

The journal is the queue, so memory is bounded and nothing is lost in a crash. While the thread
keeps up, frames are drawn in order of arrival. Under overload those that would gain the fewest pixels are put off
(`draw_queue`): they are stored, are used by the refinement, and are drawn later; their number is published.
"""

import logging
import sqlite3
import threading
import time
from bisect import bisect_left
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gcs_plugin.daemon.intake.posted_pose import frame_of_row
from gcs_plugin.daemon.layers.draw_queue import DrawQueue, MapDelay, PendingFrame
from gcs_plugin.daemon.layers.layers import MapArea
from gcs_plugin.daemon.layers.live_registration import LiveRegistration
from gcs_plugin.daemon.layers.map_site import MapSite
from gcs_plugin.daemon.stoppable_thread import Background
from gcs_plugin.daemon.store import daemon_events as happened
from gcs_plugin.daemon.store import frame_rows
from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.frame_rows import POSE_KEYS, Drawn, DrawnAgain
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.picture_store import PictureStore
from orthoswarm.compute.compile_kernels import load_kernels
from orthoswarm.export.product_files import frame_row
from orthoswarm.model.camera import Camera
from orthoswarm.model.errors import OrthoSwarmError, StorageError
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.mosaic.render_passes import thumbnail
from orthoswarm.raster.picture_file import read_rgba
from orthoswarm.raster.picture_quality import PictureQuality, picture_quality

_IN_MEMORY: Final = 2000  # frames that wait; the journal has the others
_AT_ONCE: Final = 16  # pictures drawn between two looks at the queue
_LATE_S: Final = 1.0
_LOOK_S: Final = 0.5
LATENCY_S: Final = (0.1, 0.25, 0.5, 1.0, 1.5, 2.5, 5.0, 10.0, 30.0)  # bounds of the histogram in /metrics
_log = logging.getLogger(__name__)
Bytes = NDArray[np.uint8]


class Drawer(Background):
    """Draws the frames of a journal on the real-time layer.

    Attributes:
        drawn: frames drawn since the start. late: drawn later than a second after they came.
        put_off: frames that wait longer than a second, because they would show least of the waiting ones.
        latencies: seconds from arrival to the map, of the last thousand frames. latency_counts: how many frames took
            up to each of LATENCY_S, and longer; latency_sum: seconds in all.
    """

    def __init__(
        self,
        journal: Journal,
        store: PictureStore,
        site: MapSite,
        events: Events,
        *,
        in_memory: int = _IN_MEMORY,
        late_s: float = _LATE_S,
        look_s: float = _LOOK_S,
        read: Callable[[Path], Bytes] = read_rgba,
        basemap: Path | None = None,
    ) -> None:
        """Continue where the last daemon stopped; `start` begins to draw.

        Args:
            site: of the map, whose layer is drawn on.
            in_memory: most frames that wait in memory; the journal has the others.
            late_s: a frame drawn later than this after its arrival is late, seconds.
            look_s: time between looks for late frames, seconds.
            read: reads a picture file, uint8 (rows, columns, 4).
            basemap: where pictures are registered before they are drawn, None for nowhere.
        """
        super().__init__("drawing", join_s=None)
        self.registration = LiveRegistration(basemap, events, read, partial(frame_rows.drawn_in_sortie, journal))
        self._in_memory, self._late_s, self._look_s, self._read = in_memory, late_s, look_s, read
        self._journal, self._store, self._site, self._events = journal, store, site, events
        self._begun = 0
        self._queue = DrawQueue(self._in_memory)
        self._delay = MapDelay()
        self._waiting: set[int] = set()
        self._looked = 0.0
        self._more, self._found = True, False
        self._condition = threading.Condition()
        self.drawn = self.late = self.put_off = 0
        self.latencies: list[float] = []
        self.latency_counts, self.latency_sum = [0] * (len(LATENCY_S) + 1), 0.0
        self.problem = ""

    # -- from outside ---------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Stop after the present frame."""
        with self._condition:
            self._stop.set()
            self._condition.notify_all()
        super().close()

    def picture_stored(self, event: happened.PictureStored) -> None:
        """Add a frame that is in the journal."""
        with self._condition:
            self._delay.came(event.frame.vehicle, event.arrived_s)
            if event.seq not in self._waiting:
                self._put(PendingFrame(event.seq, event.arrived_s, event.sortie, event.frame))
            self._condition.notify_all()

    def vehicle_looked_for(self, event: happened.VehicleLookedFor) -> None:
        """Draw a vehicle's pictures again where they were found on the basemap."""
        self.registration.vehicle_looked_for(event)
        with self._condition:
            self._found = True
            self._condition.notify_all()

    @property
    def area(self) -> MapArea | None:
        """The map's area, None before the first frame."""
        return self._site.area

    @property
    def backlog(self) -> int:
        """Number of frames that wait in memory, up to a bound; the others are in the journal."""
        return len(self._queue)

    @property
    def behind_s(self) -> float:
        """How long the map has been waiting for some vehicle's newest pictures, seconds, see MapDelay."""
        with self._condition:
            return self._delay.seconds(time.time())

    def wait_drawn(self, vehicle: str, sortie: int | None, timeout_s: float) -> bool:
        """Wait until a sortie's frames are drawn; False after the time-out."""
        end = time.monotonic() + timeout_s
        while not frame_rows.sortie_is_drawn(self._journal, vehicle, sortie):
            if time.monotonic() > end or self._stop.is_set():
                return False
            time.sleep(0.05)
        return True

    # -- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        load_kernels("canvas", "mosaic.kernels", "raster")
        while True:
            with self._condition:
                while not (len(self._queue) or self._more or self._found or self._stop.is_set()):
                    self._condition.wait()
                if self._stop.is_set():
                    return
            try:
                self._refill()
                self._draw_found()
                self._draw_some()
                self._tell_overload()
                self.problem = ""
            except OrthoSwarmError as error:  # the disk is full, or gone: nothing is lost, try again
                self._complain(str(error))
            except sqlite3.Error as error:
                self._complain(f"the journal cannot be read ({error})")

    def _complain(self, problem: str) -> None:
        if problem != self.problem:
            self.problem = problem
            _log.error("drawing waits: %s", problem)
            self._events.tell("problem", text=problem)
        with self._condition:
            self._waiting = self._queue.seqs()
            self._more = True
            self._condition.wait(1.0)

    def _tell_overload(self) -> None:
        """Publish the number of frames put off (from the journal) when it has changed.

        It is looked up once in a while, and at the end of a jam, after which nothing else leads here.
        """
        now, left = time.monotonic(), len(self._queue) > 0 or self._more
        if not (self.put_off or len(self._queue) > _AT_ONCE or self._more):
            return
        if left and now - self._looked < self._look_s:
            return
        self._looked = now
        before, self.put_off = self.put_off, frame_rows.undrawn_before(self._journal, time.time() - self._late_s)
        if bool(before) != bool(self.put_off):
            if self.put_off:
                _log.warning("%s", self.overload)
            else:
                _log.info("all pictures are on the map again")
        if before != self.put_off:
            self._events.tell("overload", put_off=self.put_off, text=self.overload)

    @property
    def overload(self) -> str:
        """A sentence about frames that are put off; empty if there are none."""
        if not self.put_off:
            return ""
        return (
            f"more pictures come than can be drawn at once: {self.put_off} that would show least are put off;"
            " they are safe on the disk and are drawn when there is time"
        )

    def _refill(self) -> None:
        with self._condition:
            if not self._more or len(self._queue) > self._in_memory // 2:
                return
            self._more = False
        most = self._in_memory + len(self._waiting) + 1
        rows = frame_rows.undrawn_frames(self._journal, most)
        with self._condition:
            self._more = self._more or len(rows) == most
            for row in rows:
                if row.seq not in self._waiting:
                    if len(self._queue) >= self._in_memory:
                        self._more = True
                        break
                    self._put(PendingFrame(row.seq, row.arrived_s, row.sortie, frame_of_row(row, self._store)))

    def _put(self, pending: PendingFrame) -> None:
        self._waiting.add(pending.seq)
        left = self._queue.put(pending)
        if left is not None:  # it is found in the journal when there is room
            self._waiting.discard(left.seq)
            self._more = True

    def _draw_some(self) -> None:
        done: list[Drawn] = []
        seqs: list[int] = []
        while len(done) < _AT_ONCE:
            with self._condition:
                pending = None if self._stop.is_set() else self._queue.take()
            if pending is None:
                break
            begun = self._begun
            result = self._draw(pending)
            if self._begun != begun:
                done.clear()  # what was drawn before on another map is drawn again
            done.append(result)
            seqs.append(pending.seq)
            self._note(pending, result)
        if done:
            self._journal.write(frame_rows.frames_drawn(done))
            self._events.tell("layer", layer="realtime", version=self._site.layer.version)
        with self._condition:
            self._waiting.difference_update(seqs)
            self._condition.notify_all()

    def _draw_found(self) -> None:
        """Draw pictures of vehicles that have been found on the basemap where they lie there."""
        with self._condition:
            found, self._found = self._found, False
        area, mosaic = self._site.area, self._site.mosaic
        if not found or area is None or mosaic is None:
            return
        done = []
        for pending, pose in self.registration.found(area):
            if mosaic.add(self._read(pending.frame.path), pose.camera, pose.ground_z_m).reason is None:
                camera = self._document(pending, pose.camera, pose.ground_z_m, pose.sigma_m, "map")
                done.append(DrawnAgain(pending.seq, pose.sigma_m, camera))
        if done:
            self._journal.write(frame_rows.frames_moved(done))
            self._events.tell("layer", layer="realtime", version=self._site.layer.version)

    def _note(self, pending: PendingFrame, result: Drawn) -> None:
        took = time.time() - pending.arrived
        with self._condition:
            self._delay.drawn(pending.frame.vehicle, pending.arrived)
        self.drawn += 1
        self.late += took > self._late_s
        self.latencies.append(took)
        self.latency_counts[bisect_left(LATENCY_S, took)] += 1
        self.latency_sum += took
        del self.latencies[:-1000]

    def draw_anew(self, _: happened.DrawingRestarted) -> None:
        """All frames are drawn again, by what the journal says."""
        self._begun += 1
        self.registration.forget()
        with self._condition:
            self._queue.forget_drawn()
            self._more = True

    # -- one frame ------------------------------------------------------------------------------------------------

    def _draw(self, pending: PendingFrame) -> Drawn:
        frame = pending.frame
        try:
            place = self._site.place(frame, self.drawn)
            if isinstance(place, str):
                self._events.publish(happened.PictureRejected(frame, place, True))
                return self._report(pending, Drawn(pending.seq, place, None), None)
            camera, sigma = place
            picture = self._read(frame.path)
            mosaic = self._site.mosaic
            assert mosaic is not None
            pose, level = self.registration.place(pending, picture, len(self._queue)), 0.0
            if pose is not None:
                camera, level, sigma = pose.camera, pose.ground_z_m, pose.sigma_m
            by_receiver = pose is None and self.registration.works
            added = mosaic.add(picture, camera, level, weak=frame.damaged, by_receiver=by_receiver)
        except StorageError:  # the disk is full, or gone: later
            raise
        except OrthoSwarmError as error:
            reason = str(error).replace(frame.path.name, frame.image)  # as its sender calls it, not the store
            self._events.publish(happened.PictureRejected(frame, reason, False))
            return self._report(pending, Drawn(pending.seq, reason, None), None)
        except (ValueError, ArithmeticError) as error:
            return self._report(pending, Drawn(pending.seq, f"it cannot be drawn ({error})", None), None)
        quality = _quality(picture)
        if added.reason is None:
            self._events.publish(happened.PictureDrawn(PlacedFrame(frame, camera, "realtime", sigma), quality))
        by = "receiver" if pose is None else "map"
        document = None if added.reason else self._document(pending, camera, level, sigma, by)
        small = thumbnail(picture).tobytes()
        return self._report(
            pending, Drawn(pending.seq, added.reason, sigma, thumbnail=small, quality=quality, placed=document), camera
        )

    def _document(self, pending: PendingFrame, camera: Camera, level: float, sigma_m: float, by: str) -> dict[str, Any]:
        """What the journal keeps of a drawn picture's place: by what, how soon, and its homography."""
        assert self._site.grid is not None
        row = frame_row(PlacedFrame(pending.frame, camera, "realtime", sigma_m), self._site.grid, level)
        pose = {key: row[key] for key in POSE_KEYS if key in row} | {"ground_z_m": level}
        after_s = round(time.time() - pending.arrived, 3)
        return {"placed_by": by, "placed_after_s": after_s, "sigma_m": sigma_m, "pose": pose}

    def _report(self, pending: PendingFrame, drawn: Drawn, camera: Camera | None) -> Drawn:
        frame, fix = pending.frame, pending.frame.fix
        outline, grid = None, self._site.grid
        if camera is not None and grid is not None and drawn.reason is None:
            corners = camera.corners()
            if np.isfinite(corners).all():
                outline = [[float(lon), float(lat)] for lat, lon in grid.to_geographic(corners)]
        self._events.tell(
            "frame", seq=drawn.seq, vehicle=frame.vehicle, image=frame.image, sortie=pending.sortie,
            stage="rejected" if drawn.reason else "realtime", reason=drawn.reason, sigma_m=drawn.sigma_m,
            lat_deg=fix.lat_deg, lon_deg=fix.lon_deg, outline=outline,
        )  # fmt: skip
        return drawn


def _quality(picture: Bytes) -> PictureQuality | None:
    try:
        return picture_quality(picture)
    except ValueError:  # too small to be judged
        return None

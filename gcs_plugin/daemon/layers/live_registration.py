"""Each vehicle's pictures registered on the basemap as they come, before they are drawn.

A vehicle's first pictures are drawn where its receiver says, and refined together in a worker process. Once evidence
places them on the basemap, they are drawn again there, and each picture after them is placed as it comes (`LiveBlock`).
A vehicle that gets lost begins anew. The drawing thread calls everything here but `vehicle_looked_for`.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from gcs_plugin.daemon.layers.draw_queue import PendingFrame
from gcs_plugin.daemon.layers.layers import MapArea
from gcs_plugin.daemon.store.daemon_events import Events, FirstPicturesCame, VehicleLookedFor
from gcs_plugin.daemon.store.frame_rows import Whose
from orthoswarm.model.arrays import Gray
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.raster.basemap import Basemap

if TYPE_CHECKING:
    from orthoswarm.refine.sequential.live_block import LiveBlock, LivePose

Bytes = NDArray[np.uint8]

FIRST: Final = 20  # pictures of a vehicle that are looked for on the basemap together
MOST_LOOKED_FOR: Final = 60  # ... of many that were not found, the newest
MORE: Final = 1.4  # ... again when there are so many times as many
_ANSWER_S: Final = 60.0  # an answer that has not come by then was lost with its job
_BUSY: Final = 50  # waiting pictures for each further one that is only placed by its neighbours
_MOST_BETWEEN: Final = 3  # most pictures in a row that are: corners have to be followed across them
_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class _Flown:
    """A sortie: its newest pictures that are not registered, how many there were, and its block once it is found."""

    waiting: list[PendingFrame] = field(default_factory=list)
    came: int = 0
    block: "LiveBlock | None" = None
    wanted: int = FIRST
    asked_s: float = -_ANSWER_S
    between: int = 0


class LiveRegistration:
    """The live blocks of all vehicles.

    Args:
        basemap: where vehicles are registered; None for none. events: told when there are enough first pictures.
        read: reads a picture file, uint8 (rows, columns, 4). drawn: how many pictures of a sortie are drawn already.
    """

    def __init__(
        self, basemap: Path | None, events: Events, read: Callable[[Path], Bytes], drawn: Callable[[Whose], int]
    ) -> None:
        self._basemap, self._events, self._read, self._drawn = basemap, events, read, drawn
        self._flown: dict[Whose, _Flown] = {}
        self._answers: deque[VehicleLookedFor] = deque()

    @property
    def works(self) -> bool:
        """Whether there is a basemap to register on."""
        return self._basemap is not None

    def vehicle_looked_for(self, event: VehicleLookedFor) -> None:
        """Take over where a vehicle's first pictures lie; any thread."""
        self._answers.append(event)

    def forget(self) -> None:
        """Begin anew, as the map is drawn again."""
        self._flown.clear()
        self._answers.clear()

    def place(self, pending: PendingFrame, picture: Bytes, waiting: int) -> "LivePose | None":
        """Where a picture lies; None: where its receiver says.

        Args:
            pending: later pictures of a vehicle come later. picture: uint8 (rows, columns, 4).
            waiting: how many pictures wait to be drawn.
        """
        if not self.works or pending.frame.damaged:
            return None
        whose = (pending.frame.vehicle, pending.sortie)
        flown = self._flown.get(whose)
        if flown is None:  # of a sortie that was under way before a restart, those from before count
            flown = self._flown[whose] = _Flown(came=min(self._drawn(whose), FIRST - 1))
        if flown.block is not None and _size(flown.block.newest) != _size(pending.frame):
            return None  # another lens than the one that was found
        pose = None if flown.block is None else self._next(flown, pending, picture, waiting)
        if pose is None:
            flown.waiting.append(pending)
            flown.came += 1
            del flown.waiting[: -2 * MOST_LOOKED_FOR]
            now = time.monotonic()
            if flown.came >= flown.wanted and now > flown.asked_s + _ANSWER_S:
                flown.asked_s = now
                self._events.publish(FirstPicturesCame(*whose))
        return pose

    def _next(self, flown: _Flown, pending: PendingFrame, picture: Bytes, waiting: int) -> "LivePose | None":
        block, frame = flown.block, pending.frame
        assert block is not None
        flown.between += 1
        if _order(frame.time_s) <= _order(block.newest.time_s):
            return block.near(frame)
        if flown.between <= min(waiting // _BUSY, _MOST_BETWEEN):
            return block.near(frame)
        flown.between = 0
        try:
            pose = block.add(frame, grey(picture, block.size))
        except OrthoSwarmError as error:
            _log.info("%s is lost on the basemap: %s", frame.vehicle, error)
            pose = None
        if pose is None:
            flown.block, flown.waiting, flown.came, flown.wanted = None, [], 0, FIRST
        return pose

    def found(self, area: MapArea) -> "Iterator[tuple[PendingFrame, LivePose]]":
        """The pictures of vehicles that have been found since, in order, with their places."""
        while self._answers:
            event = self._answers.popleft()
            flown = self._flown.get((event.vehicle, event.sortie))
            if flown is None or flown.block is not None:
                continue
            flown.asked_s = -_ANSWER_S
            if event.solution is None or event.epsg != area.epsg:
                flown.wanted = int(MORE * max(flown.came, flown.wanted))
                continue
            try:
                yield from self._begun(flown, event, area)
            except OrthoSwarmError as error:
                _log.info("%s cannot be registered in flight: %s", event.vehicle, error)
                flown.block = None

    def _begun(
        self, flown: _Flown, event: VehicleLookedFor, area: MapArea
    ) -> "Iterator[tuple[PendingFrame, LivePose]]":
        """Begin a vehicle's block; its first pictures, then those that have come since."""
        from orthoswarm.refine.sequential.live_block import LiveBlock

        assert event.solution is not None and self._basemap is not None
        state, origin = event.solution.state, np.array(area.origin)
        block = LiveBlock(state, LocalGrid(area.epsg), origin, Basemap.open(self._basemap, area.epsg))
        placed = {p.frame.image: p for p in event.solution.placed}
        waiting, flown.waiting, flown.wanted, flown.block = flown.waiting, [], FIRST, block
        for pending in waiting:
            first = placed.get(pending.frame.image)
            if first is not None:
                yield pending, block.begun(first)
        newest = _order(block.newest.time_s)
        for n, pending in enumerate(waiting):
            if pending.frame.image in placed or _order(pending.frame.time_s) <= newest:
                continue
            pose = self._next(flown, pending, self._read(pending.frame.path), 0)
            if pose is None:
                flown.waiting, flown.came = waiting[n:], len(waiting) - n
                return
            yield pending, pose


def grey(picture: Bytes, size: tuple[int, int]) -> Gray:
    """Grey values of a picture, uint8, at a size (columns, rows)."""
    gray = cv2.cvtColor(picture, cv2.COLOR_RGBA2GRAY)
    if gray.shape[::-1] != size:
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return np.asarray(gray, np.uint8)


def _size(frame: Frame) -> tuple[int, int]:
    return frame.width, frame.height


def _order(time_s: float | None) -> float:
    return 0.0 if time_s is None else time_s

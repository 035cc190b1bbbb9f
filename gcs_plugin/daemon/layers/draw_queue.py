"""The queue of frames to be drawn, bounded; in order of arrival while few wait, else of their use for the map.

A map pixel shows the picture with the nearest nadir point, so a frame gains fewer pixels the nearer its nadir lies
to one that is drawn already: its share of the map is its cell of the Voronoi diagram of all nadirs. That distance, in
steps of a twentieth of a footprint, is a frame's level; the highest level goes first, within a level the oldest. When
more wait than the memory bound allows, those of the lowest level are dropped: they stay in the journal, undrawn.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

from orthoswarm.model.earth import DEGREE_M
from orthoswarm.model.frame import DEFAULT_HEIGHT_M, Frame

LEVELS: Final = 8  # of spacing, the coarsest first
_IN_ORDER: Final = 32  # while no more wait, none is put off: a quarter of a second of work
_STEP_SHARE: Final = 0.06  # of the height above ground: distance of pictures on the finest level


@dataclass(frozen=True, slots=True)
class PendingFrame:
    """A frame to be drawn: its number, when it came (UTC epoch seconds), its sortie."""

    seq: int
    arrived: float
    sortie: int
    frame: Frame


class MapDelay:
    """How long the map has been waiting for a vehicle's newest pictures.

    Pictures that are put off because later ones of their vehicle were drawn do not count: the map shows where the
    vehicle is. It is not thread-safe.
    """

    def __init__(self) -> None:
        self._newer: dict[str, deque[float]] = {}  # when those came that are newer than their vehicle's last drawn one

    def came(self, vehicle: str, arrived: float) -> None:
        """Note a picture that came (UTC epoch seconds)."""
        self._newer.setdefault(vehicle, deque()).append(arrived)

    def drawn(self, vehicle: str, arrived: float) -> None:
        """Note that the picture of a vehicle that came at this time is drawn."""
        newer = self._newer.get(vehicle, deque())
        while newer and newer[0] <= arrived:
            newer.popleft()

    def seconds(self, now: float) -> float:
        """The longest time that any vehicle has had pictures newer than all that are drawn of it."""
        return max((now - newer[0] for newer in self._newer.values() if newer), default=0.0)


class DrawQueue:
    """The queue; it is not thread-safe.

    Args:
        most: how many may wait. in_order: while no more wait, the first that came is the next.
    """

    def __init__(self, most: int, in_order: int = _IN_ORDER) -> None:
        self.most, self._in_order = most, in_order
        self._queues: list[deque[PendingFrame]] = [deque() for _ in range(LEVELS)]
        self._drawn: set[tuple[int, int]] = set()
        self._step_m = 0.0
        self._east_m = DEGREE_M
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def put(self, pending: PendingFrame) -> PendingFrame | None:
        """Add a frame; returns the one dropped for it (possibly itself), None if there is room."""
        level = self._level(pending.frame)
        left: PendingFrame | None = None
        if self._count >= self.most:
            lowest = next(k for k, queue in enumerate(self._queues) if queue)
            if lowest >= level:
                return pending
            left = self._queues[lowest].popleft()
            self._count -= 1
        self._queues[level].append(pending)
        self._count += 1
        return left

    def take(self) -> PendingFrame | None:
        """The frame to be drawn next, counted as drawn from now on; None if there is none.

        The first that came while few wait: each is registered by the one before.
        """
        if self._count <= self._in_order:
            waiting = [queue for queue in self._queues if queue]
            if not waiting:
                return None
            self._count -= 1
            pending = min(waiting, key=lambda queue: queue[0].seq).popleft()
            self._drawn.add(self._cell(pending.frame))
            return pending
        for level in range(LEVELS - 1, -1, -1):
            queue = self._queues[level]
            while queue:
                pending = queue.popleft()
                now = self._level(pending.frame)
                if now < level:  # others nearby were drawn meanwhile
                    self._queues[now].append(pending)
                    continue
                self._count -= 1
                self._drawn.add(self._cell(pending.frame))
                return pending
        return None

    def seqs(self) -> set[int]:
        """The numbers of all that wait."""
        return {pending.seq for queue in self._queues for pending in queue}

    def forget_drawn(self) -> None:
        """Forget what was drawn, as the map is drawn again."""
        self._drawn.clear()

    def _cell(self, frame: Frame) -> tuple[int, int]:
        fix = frame.fix
        if self._step_m == 0.0:  # the first frame sets the scale
            self._step_m = max(0.5, _STEP_SHARE * (fix.height_m or DEFAULT_HEIGHT_M))
            self._east_m = DEGREE_M * max(0.05, math.cos(math.radians(fix.lat_deg)))
        return (int(fix.lat_deg * DEGREE_M / self._step_m // 1), int(fix.lon_deg * self._east_m / self._step_m // 1))

    def _level(self, frame: Frame) -> int:
        """Rings of cells around a frame's nadir without a drawn one, at most LEVELS - 1."""
        row, col = self._cell(frame)
        drawn = self._drawn
        if (row, col) in drawn:
            return 0
        for ring in range(1, LEVELS - 1):
            for k in range(-ring, ring + 1):
                if (
                    (row - ring, col + k) in drawn
                    or (row + ring, col + k) in drawn
                    or (row + k, col - ring) in drawn
                    or (row + k, col + ring) in drawn
                ):
                    return ring
        return LEVELS - 1

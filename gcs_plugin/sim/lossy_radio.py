"""A simulated bad radio link: packets are lost, repeated and delayed, reproducibly, in simulated time."""

import heapq
import itertools
import math
from dataclasses import dataclass, field
from random import Random
from typing import Final, Generic, TypeVar

Cargo = TypeVar("Cargo")

_QUEUE_S: Final = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Faults of a link, applied to each packet independently.

    Attributes:
        loss: share of packets lost, 0 to 1.
        duplicate: share of packets that arrive twice.
        delay_s: least and greatest delay; packets overtake each other within it.
        silent: intervals (from, to) in seconds in which nothing gets through.
        seed: equal seeds give equal faults.
        bytes_s: capacity, bytes per second; packets queue up, and those that would wait longer than a second are lost.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    delay_s: tuple[float, float] = (0.0, 0.0)
    silent: tuple[tuple[float, float], ...] = ()
    seed: int = 0
    bytes_s: float = math.inf

    @property
    def any(self) -> bool:
        """True if any fault is set."""
        slow = self.bytes_s < math.inf
        return bool(self.loss or self.duplicate or self.delay_s[1] or self.silent or slow)


NO_FAULTS: Final = Faults()


@dataclass(slots=True, kw_only=True)
class Channel(Generic[Cargo]):
    """One direction of a link; `lost` counts its lost packets."""

    faults: Faults
    lost: int = 0
    _random: Random = field(init=False)
    _free_at: float = 0.0
    _queue: list[tuple[float, int, Cargo]] = field(default_factory=list)
    _order: "itertools.count[int]" = field(default_factory=itertools.count)

    def __post_init__(self) -> None:
        """Seed the faults."""
        self._random = Random(self.faults.seed)

    def put(self, cargo: Cargo, now: float, size: int = 0) -> None:
        """Send a packet of so many bytes."""
        faults, random = self.faults, self._random
        if random.random() < faults.loss or any(start <= now < end for start, end in faults.silent):
            self.lost += 1
            return
        begins = max(now, self._free_at)
        if begins - now > _QUEUE_S:
            self.lost += 1
            return
        self._free_at = begins + size / faults.bytes_s
        for _ in range(2 if random.random() < faults.duplicate else 1):
            arrival = self._free_at + random.uniform(*faults.delay_s)
            heapq.heappush(self._queue, (arrival, next(self._order), cargo))

    def take(self, now: float) -> list[Cargo]:
        """The packets that have arrived, in order of arrival."""
        arrived: list[Cargo] = []
        while self._queue and self._queue[0][0] <= now:
            arrived.append(heapq.heappop(self._queue)[2])
        return arrived

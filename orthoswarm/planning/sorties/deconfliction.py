"""Keeping vehicles apart: heights for the ways out and home, and times of takeoff.

Vehicles are placed one after the other, the longest flight first, or the shortest. Each takes the takeoff time and the
layers (heights of its way out and of its way home) that cost least and keep it apart from all placed before: at any
moment, and some seconds earlier or later, far enough away or at another height. For one pair of layers every moment at
which two paths come close forbids a short interval of takeoff times, so the earliest time left is found in one pass.
Around a start that they share, vehicles take off and land in turn, for which fewer seconds are allowed; where that
would take too long, only some time after each other, because they stand some metres apart there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.config.autopilot import ARDUPILOT
from orthoswarm.config.planning import PLANNING
from orthoswarm.model.arrays import Array, Flags, Indices
from orthoswarm.model.plan import APART, ON_GROUND_M, PAD_DISTANCES
from orthoswarm.planning.sorties.flight_path import Flight
from orthoswarm.planning.sorties.flight_time import Motion, start_slack_s

Maker = Callable[[float, float], Flight]

_STEP_S: Final = 0.5  # time step in which flights are compared (for its time)
_ORDERS_TRIED_SHARE: Final = 2.0 / 3.0
"""Where a smaller share of the vehicles has its turn in time, another order of them does not help."""
_LAYER_PRICE_S: Final = 3.0  # price of each further height layer, in seconds of delay


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """How far apart vehicles stay."""

    distance_m: float = APART.distance_m  # horizontally, or
    height_m: float = APART.height_m  # vertically, the height of a layer
    layers: int = 4  # how many layers there are above the legs' height
    # how much earlier or later than planned a vehicle may be. Around a start that vehicles share, it is what their
    # autopilots need there (`takeoff_slack_s`, `landing_slack_s`), at most this
    slack_s: float = ARDUPILOT.schedule_slack_s
    launch_s: float = PLANNING.launch_s  # time between takeoffs, and between landings, at one start
    swap_s: float = 120.0  # time on the ground between a vehicle's sorties
    # vehicles of one start take off and land in turn if all takes at most so much longer by that
    in_turn_share: float = PLANNING.in_turn_share

    @property
    def pad_m(self) -> float:
        """Radius about a start that vehicles share, metres."""
        return PAD_DISTANCES * self.distance_m


@dataclass(frozen=True)
class Slot:
    """What a sortie was given."""

    out_layer: int  # layer of its way out, 0 is the legs' height
    home_layer: int  # layer of its way home
    start_s: float  # its takeoff, seconds after the swarm's start
    flight: Flight  # its path


@dataclass(frozen=True)
class Schedule:
    """What all sorties were given."""

    slots: list[list[Slot]]  # per vehicle and sortie
    in_turn: bool = True  # vehicles of one start keep apart in height as they take off and land; if not, in time alone
    saved_s: float = 0.0  # by at least how much all is done sooner without that, 0 if they do


@dataclass(frozen=True)
class _Track:
    """Positions every half second in the air."""

    home: Array  # float64 (2,), where it takes off
    ground: int  # so many samples pass on the ground before the first
    places: Array  # float64 (n, 3)
    pad: Flags  # bool (n,), around its home
    slack: Indices  # int64 (n,), off schedule by so many samples where it shares its start: less as it takes off


def _sampled(flight: Flight, motion: Motion, apart: Separation) -> _Track:
    track = flight.track()
    waits = np.zeros(len(track))
    if flight.wait_s > 0.0:  # it comes to where it waits, and stays there
        at = 3 + flight.last_leg_end
        track, waits = np.insert(track, at, track[at - 1], axis=0), np.insert(waits, at, flight.wait_s)
    places = motion.places(track, waits, _STEP_S)
    flying = np.flatnonzero(places[:, 2] > flight.home_z_m + ON_GROUND_M)
    places = np.ascontiguousarray(places[flying[0] : flying[-1] + 1])
    pad = np.hypot(*(places[:, :2] - flight.home).T) < apart.pad_m
    slack = np.ceil(np.minimum(start_slack_s(pad, motion.autopilot), apart.slack_s) / _STEP_S).astype(np.int64)
    return _Track(flight.home, int(flying[0]), places, pad, slack)


@kernel
def _bins(points, low, cell, shape):  # type: ignore[no-untyped-def]
    """Points (n, 2 or 3) sorted by raster cell: their order, and where each cell begins."""
    where = np.empty(len(points), np.int64)
    start = np.zeros(shape[0] * shape[1] + 1, np.int64)
    for i in range(len(points)):
        where[i] = int((points[i, 0] - low[0]) / cell) * shape[1] + int((points[i, 1] - low[1]) / cell)
        start[where[i] + 1] += 1
    start = np.cumsum(start)
    fill, order = start[:-1].copy(), np.empty(len(points), np.int64)
    for i in range(len(points)):
        order[fill[where[i]]] = i
        fill[where[i]] += 1
    return order, start


@in_place_kernel
def _forbid(mine, begin, slacks, others, when, other_slacks, bins, raster, apart, marks):  # type: ignore[no-untyped-def]
    """Mark delays (in samples) at which a track comes near others: +1 where an interval begins, -1 behind its end.

    slacks: in samples, of two the larger counts; raster: low x, low y, cell, columns, rows; apart: distance, height.
    """
    order, start = bins
    distance, height = apart[0], apart[1]
    cell, columns, rows = raster[2], int(raster[3]), int(raster[4])
    for i in range(len(mine)):
        x, y = int(np.floor((mine[i, 0] - raster[0]) / cell)), int(np.floor((mine[i, 1] - raster[1]) / cell))
        for u in range(max(0, x - 1), min(columns, x + 2)):
            for v in range(max(0, y - 1), min(rows, y + 2)):
                for k in range(start[u * rows + v], start[u * rows + v + 1]):
                    j = order[k]
                    dx, dy, dz = mine[i, 0] - others[j, 0], mine[i, 1] - others[j, 1], mine[i, 2] - others[j, 2]
                    if dx * dx + dy * dy < distance * distance and abs(dz) < height:
                        delay, slack = when[j] - begin[i], max(slacks[i], other_slacks[j])
                        first, last = max(0, delay - slack), min(len(marks) - 2, delay + slack)
                        if last >= first:
                            marks[first] += 1
                            marks[last + 1] -= 1


_Placed = tuple[Array, Indices, Indices, tuple[Indices, Indices], Array]  # others, when, other_slacks, bins, raster


def _in_cells(points: Array, when: Indices, slack: Indices, cell_m: float) -> _Placed:
    """Samples of placed flights in raster cells, as `_forbid` takes them."""
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    cell = max(cell_m, float((high - low).max()) / 1000.0)
    shape = ((high - low) / cell).astype(np.int64) + 1
    return points, when, slack, _bins(points, low, cell, shape), np.array([*low, cell, *shape], np.float64)


class _Sky:
    """The flights placed so far."""

    def __init__(self, speed_m_s: float, apart: Separation, in_turn: bool) -> None:
        self._apart, self._in_turn = apart, in_turn
        self._tracks: list[tuple[int, _Track]] = []
        # Between samples a vehicle moves: half a step is added to the distance to keep.
        self._reach = apart.distance_m + 0.5 * _STEP_S * speed_m_s

    def place(self, make: Maker, motion: Motion, ready_s: float) -> Slot:
        """Give a flight its layers and takeoff, not before it is ready, and remember it."""
        ready = int(np.ceil(ready_s / _STEP_S))
        layers = self._apart.layers + 1
        pairs = sorted(((o, h) for o in range(layers) for h in range(layers)), key=lambda p: (sum(p), p))
        frozen = self._frozen(make(0.0, 0.0).home)
        best: tuple[float, Slot, _Track, int] | None = None
        soonest = 0.0
        for out, home in pairs:
            price = _LAYER_PRICE_S * (out + home)
            if best is not None and price + soonest >= best[0]:
                break
            flight = make(out * self._apart.height_m, home * self._apart.height_m)
            track = _sampled(flight, motion, self._apart)
            marks = self._launches(track, ready)
            if best is None:  # whatever the layers, takeoffs at one start come one after the other
                soonest = _first_zero(marks) * _STEP_S
            self._meetings(track, ready, frozen, marks)
            delay = _first_zero(marks)
            if best is None or price + delay * _STEP_S < best[0]:
                slot = Slot(out, home, (ready + delay) * _STEP_S, flight)
                best = (price + delay * _STEP_S, slot, track, ready + delay)
        assert best is not None
        self._tracks.append((best[3], best[2]))
        return best[1]

    def _frozen(self, home: Array) -> list[tuple[bool, _Placed]]:
        """The placed samples elsewhere, and around a start shared with a vehicle at home (True)."""
        if not self._tracks:
            return []
        points = np.concatenate([t.places for _, t in self._tracks])
        pad = np.concatenate([t.pad & self._shared(t.home, home) for _, t in self._tracks])
        when = np.concatenate([s + t.ground + np.arange(len(t.places)) for s, t in self._tracks])
        slack = np.concatenate([t.slack for _, t in self._tracks])
        slack[~pad] = self._slack
        kinds = ((False, ~pad), (True, pad))
        return [(near, _in_cells(points[w], when[w], slack[w], self._reach)) for near, w in kinds if w.any()]

    @property
    def _slack(self) -> int:
        """How many samples a vehicle may be off schedule away from its start."""
        return int(np.ceil(self._apart.slack_s / _STEP_S))

    def _launches(self, track: _Track, ready: int) -> Indices:
        """Delays that takeoffs from the same start forbid, as marks; room for all others."""
        apart = self._apart
        slack, gap = self._slack, int(np.ceil(apart.launch_s / _STEP_S))
        end = max((s + t.ground + len(t.places) for s, t in self._tracks), default=0)
        marks = np.zeros(max(1, end - ready) + slack + gap + 3, np.int64)
        for start, other in self._tracks:
            if self._shared(other.home, track.home):
                _mark(marks, start - ready, gap - 1)
        return marks

    def _shared(self, home: Array, other: Array) -> bool:
        """Two places of takeoff count as one start."""
        return bool(np.hypot(*(home - other)) < self._apart.pad_m)

    def _meetings(self, track: _Track, ready: int, frozen: list[tuple[bool, _Placed]], marks: Indices) -> None:
        """Mark delays that bring a track too near a placed one, or to the same start at the same time."""
        apart = self._apart
        # Layers are apart: the hair keeps neighbouring ones from clashing by rounding.
        limits = np.array([self._reach, apart.height_m - 0.01])
        when = ready + track.ground + np.arange(len(track.places))
        usual = np.full(len(when), self._slack)
        for near, placed in frozen:
            away = ~track.pad if near else np.ones(len(when), bool)
            _forbid(track.places[away], when[away], usual[away], *placed, limits, marks)
            if self._in_turn:
                _forbid(track.places[~away], when[~away], track.slack[~away], *placed, limits, marks)
        for start, other in self._tracks:
            if self._shared(other.home, track.home):
                landing = start + other.ground + len(other.places) - track.ground - len(track.places)
                _mark(marks, landing - ready, int(np.ceil(apart.launch_s / _STEP_S)) - 1)


def _mark(marks: Indices, delay: int, slack: int) -> None:
    first, last = max(0, delay - slack), min(len(marks) - 2, delay + slack)
    if last >= first:
        marks[first] += 1
        marks[last + 1] -= 1


def _first_zero(marks: Indices) -> int:
    return int(np.argmax(np.cumsum(marks) == 0))


def separate(sorties: Sequence[Sequence[Maker]], motions: Sequence[Motion], apart: Separation) -> Schedule:
    """Layers and takeoff times for all sorties of all vehicles.

    Args:
        sorties: per vehicle and sortie, what makes its flight with the way out, and the way home, so many metres
            higher than the legs. motions: say where each vehicle is when. apart: the distances to keep.
    """
    usual = _Placing(sorties, motions, apart)
    if not usual.shares_starts:
        usual.place_within(np.inf)
        return Schedule(usual.slots)
    # In turn, flights that are home before others come home are worth as much as long ones that start early.
    in_turn = [usual, _Placing(sorties, motions, apart, shortest_first=True)]
    most = 1.0 + apart.in_turn_share
    best = _soonest(in_turn, most * usual.soonest_s)
    if best is not None:
        return Schedule(best.slots)
    at_once = _Placing(sorties, motions, apart, in_turn=False)
    at_once.place_within(np.inf)
    best = _soonest(in_turn, most * at_once.done_s)
    if best is not None:
        return Schedule(best.slots)
    later_s = min(way.done_s for way in in_turn if way.done_s > most * at_once.done_s)
    return Schedule(at_once.slots, in_turn=False, saved_s=later_s - at_once.done_s)


def _soonest(ways: "Sequence[_Placing]", limit_s: float) -> "_Placing | None":
    """The one that is done first, None if none can be done by the limit."""
    best = None
    for way in ways:
        if way.place_within(limit_s if best is None else min(limit_s, best.done_s)):
            best = way
        elif way.placed_share < _ORDERS_TRIED_SHARE:
            break
    return best


class _Placing:
    """Sorties on their way to a schedule: placed one after the other, and no further than it is worth.

    Attributes:
        slots: per vehicle, those of its sorties that are placed.
        done_s: when the last of them ends, and what must follow it.
    """

    def __init__(
        self,
        sorties: Sequence[Sequence[Maker]],
        motions: Sequence[Motion],
        apart: Separation,
        *,
        in_turn: bool = True,
        shortest_first: bool = False,
    ) -> None:
        self._sorties, self._motions, self._apart = sorties, motions, apart
        self._shortest_first = shortest_first
        self._sky = _Sky(max(motion.speed_m_s for motion in motions), apart, in_turn)
        flights = [[make(0.0, 0.0) for make in row] for row in sorties]
        self._least_s = [[f.time_s(motion) for f in row] for row, motion in zip(flights, motions, strict=True)]
        self._homes = np.array([row[0].home for row in flights])
        self._queue: list[int] = []  # vehicles in the order in which their next sorties are placed
        self.slots: list[list[Slot]] = [[] for _ in sorties]
        self.done_s = 0.0

    @property
    def shares_starts(self) -> bool:
        """Two vehicles take off at one start."""
        return bool(np.triu(self._one_start, 1).any())

    @property
    def soonest_s(self) -> float:
        """No schedule is done sooner: at one start the longest flights take off first, one after the other."""
        whole_s = np.array([self._needs_s(vehicle, 0) for vehicle in range(len(self._sorties))])
        one_start, soonest = self._one_start, 0.0
        for row in one_start:
            near = one_start[np.ix_(row, row)].all()
            together = np.sort(whole_s[row])[::-1] if near else whole_s[row].max(keepdims=True)
            soonest = max(soonest, float((together + self._apart.launch_s * np.arange(len(together))).max()))
        return soonest

    def place_within(self, limit_s: float) -> bool:
        """Place sorties while all can be done by then; may be called again with a later limit. False if they cannot."""
        while self.done_s <= limit_s:
            if not self._queue:
                self._queue = self._next_turn()
                if not self._queue:
                    return True
            self._place(self._queue.pop(0))
        return False

    @property
    def placed_share(self) -> float:
        """Share of the vehicles that have a place."""
        return sum(map(bool, self.slots)) / len(self.slots)

    @property
    def _one_start(self) -> Flags:
        """Pairs of vehicles that take off at one start, (n, n)."""
        away = np.hypot(*(self._homes[:, None] - self._homes[None]).transpose(2, 0, 1))
        return np.asarray(away < self._apart.pad_m)

    def _needs_s(self, vehicle: int, sortie: int) -> float:
        """Seconds from the takeoff of a sortie to the end of its vehicle's last one, if nothing delays them."""
        times = self._least_s[vehicle][sortie:]
        return sum(times) + self._apart.swap_s * (len(times) - 1)

    def _ready_s(self, vehicle: int) -> float:
        if not self.slots[vehicle]:
            return 0.0
        last = self.slots[vehicle][-1]
        return last.start_s + last.flight.time_s(self._motions[vehicle]) + self._apart.swap_s

    def _next_turn(self) -> list[int]:
        """The vehicles that fly another sortie, those done last first: a delay hurts least where there is time left."""
        left = [v for v, row in enumerate(self._sorties) if len(self.slots[v]) < len(row)]
        done_s = {v: self._ready_s(v) + self._least_s[v][len(self.slots[v])] for v in left}
        return sorted(left, key=lambda v: done_s[v] if self._shortest_first else -done_s[v])

    def _place(self, vehicle: int) -> None:
        number = len(self.slots[vehicle])
        slot = self._sky.place(self._sorties[vehicle][number], self._motions[vehicle], self._ready_s(vehicle))
        self.slots[vehicle].append(slot)
        after_s = 0.0
        if number + 1 < len(self._sorties[vehicle]):
            after_s = self._apart.swap_s + self._needs_s(vehicle, number + 1)
        ends_s = slot.start_s + slot.flight.time_s(self._motions[vehicle])
        self.done_s = max(self.done_s, ends_s + after_s)

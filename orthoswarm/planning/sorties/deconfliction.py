"""Keeping vehicles apart: heights for the ways out and home, and times of takeoff.

Vehicles are placed one after the other, the longest flight first. Each takes the takeoff time and the layers (heights
of its way out and of its way home) that cost least and keep it apart from all placed before: at any moment, and some
seconds earlier or later, far enough away or at another height. For one pair of layers every moment at which two paths
come close forbids a short interval of takeoff times, so the earliest time left is found in one pass. Around a start
that they share, vehicles take off and land in turn, for which fewer seconds are allowed; where that would take too
long, only some time after each other, because they stand some metres apart there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import kernel
from orthoswarm.config import active
from orthoswarm.planning.sorties.flight_path import Flight
from orthoswarm.planning.sorties.flight_time import Motion

Array = NDArray[np.float64]
Maker = Callable[[float, float], Flight]


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """How far apart vehicles stay.

    Attributes:
        distance_m: horizontally, or
        height_m: vertically, the height of a layer.
        layers: how many layers there are above the legs' height.
        slack_s: how much earlier or later than planned a vehicle may be; a share of it around a start that vehicles
            share (`pad_slack_s`).
        launch_s: time between takeoffs, and between landings, at one start.
        swap_s: time on the ground between a vehicle's sorties.
    """

    distance_m: float = field(default_factory=lambda: active().planning.separation_m)
    height_m: float = field(default_factory=lambda: active().planning.layer_m)
    layers: int = 4
    slack_s: float = field(default_factory=lambda: active().ardupilot.schedule_slack_s)
    launch_s: float = field(default_factory=lambda: active().planning.launch_s)
    swap_s: float = 120.0

    @property
    def pad_slack_s(self) -> float:
        """How much earlier or later than planned a vehicle may be around a start that it shares."""
        return active().planning.pad_slack_share * self.slack_s


@dataclass(frozen=True)
class Slot:
    """What a sortie was given.

    Attributes:
        out_layer: layer of its way out, 0 is the legs' height.
        home_layer: layer of its way home.
        start_s: its takeoff, seconds after the swarm's start.
        flight: its path.
    """

    out_layer: int
    home_layer: int
    start_s: float
    flight: Flight


@dataclass(frozen=True)
class Schedule:
    """What all sorties were given.

    Attributes:
        slots: per vehicle and sortie.
        in_turn: vehicles of one start keep apart in height as they take off and land; if not, in time alone.
        saved_s: how much sooner all is done without that, 0 if they do.
    """

    slots: list[list[Slot]]
    in_turn: bool = True
    saved_s: float = 0.0


@dataclass(frozen=True)
class _Track:
    """Positions every half second in the air; `ground` samples pass on the ground before the first."""

    home: Array
    ground: int
    places: Array
    pad: NDArray[np.bool_]


def _step_s() -> float:
    """Time step in which flights are compared, seconds."""
    return active().planning.step_s


def _sampled(flight: Flight, motion: Motion, pad_m: float) -> _Track:
    track = flight.track()
    times = flight.times(motion)
    if flight.wait_s > 0.0:  # it comes to where it waits, and stays there
        at = 2 + flight.last_leg_end
        track, times = np.insert(track, at, track[at], axis=0), np.insert(times, at, times[at] - flight.wait_s)
    moments = np.arange(0.0, times[-1] + _step_s(), _step_s())
    places = np.stack([np.interp(moments, times, track[:, axis]) for axis in range(3)], axis=1)
    flying = np.flatnonzero(places[:, 2] > flight.home_z_m + active().planning.on_ground_m)
    places = np.ascontiguousarray(places[flying[0] : flying[-1] + 1])
    return _Track(flight.home, int(flying[0]), places, np.hypot(*(places[:, :2] - flight.home).T) < pad_m)


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


@kernel
def _forbid(mine, begin, others, when, bins, raster, apart, marks):  # type: ignore[no-untyped-def]
    """Mark delays (in samples) at which a track comes near others: +1 where an interval begins, -1 behind its end.

    raster: low x, low y, cell, columns, rows; apart: distance, height, slack in samples.
    """
    order, start = bins
    distance, height, slack = apart[0], apart[1], int(apart[2])
    cell, columns, rows = raster[2], int(raster[3]), int(raster[4])
    for i in range(len(mine)):
        x, y = int(np.floor((mine[i, 0] - raster[0]) / cell)), int(np.floor((mine[i, 1] - raster[1]) / cell))
        for u in range(max(0, x - 1), min(columns, x + 2)):
            for v in range(max(0, y - 1), min(rows, y + 2)):
                for k in range(start[u * rows + v], start[u * rows + v + 1]):
                    j = order[k]
                    dx, dy, dz = mine[i, 0] - others[j, 0], mine[i, 1] - others[j, 1], mine[i, 2] - others[j, 2]
                    if dx * dx + dy * dy < distance * distance and abs(dz) < height:
                        delay = when[j] - begin[i]
                        first, last = max(0, delay - slack), min(len(marks) - 2, delay + slack)
                        if last >= first:
                            marks[first] += 1
                            marks[last + 1] -= 1


@dataclass(frozen=True)
class _Frozen:
    """Samples of the placed flights in raster cells: around a start that the next one shares, or elsewhere."""

    pad: bool
    points: Array
    when: NDArray[np.int64]
    bins: tuple[NDArray[np.int64], NDArray[np.int64]]
    raster: Array

    @classmethod
    def of(cls, pad: bool, points: Array, when: NDArray[np.int64], cell_m: float) -> "_Frozen":
        low, high = points[:, :2].min(0), points[:, :2].max(0)
        cell = max(cell_m, float((high - low).max()) / 1000.0)
        shape = ((high - low) / cell).astype(np.int64) + 1
        return cls(pad, points, when, _bins(points, low, cell, shape), np.array([*low, cell, *shape], np.float64))

    def forbid(self, points: Array, when: NDArray[np.int64], apart: Array, marks: NDArray[np.int64]) -> None:
        _forbid(points, when, self.points, self.when, self.bins, self.raster, apart, marks)


class _Sky:
    """The flights placed so far."""

    def __init__(self, speed_m_s: float, apart: Separation, in_turn: bool) -> None:
        self._apart, self._in_turn = apart, in_turn
        self._tracks: list[tuple[int, _Track]] = []
        # Between samples a vehicle moves: half a step is added to the distance to keep.
        self._reach = apart.distance_m + 0.5 * _step_s() * speed_m_s

    def place(self, make: Maker, motion: Motion, ready_s: float) -> Slot:
        """Give a flight its layers and takeoff, not before it is ready, and remember it."""
        ready = int(np.ceil(ready_s / _step_s()))
        layers = self._apart.layers + 1
        pairs = sorted(((o, h) for o in range(layers) for h in range(layers)), key=lambda p: (sum(p), p))
        frozen = self._frozen(make(0.0, 0.0).home)
        best: tuple[float, Slot, _Track, int] | None = None
        soonest = 0.0
        for out, home in pairs:
            price = active().planning.layer_price_s * (out + home)
            if best is not None and price + soonest >= best[0]:
                break
            flight = make(out * self._apart.height_m, home * self._apart.height_m)
            track = _sampled(flight, motion, active().planning.pad_distances * self._apart.distance_m)
            marks = self._launches(track, ready)
            if best is None:  # whatever the layers, takeoffs at one start come one after the other
                soonest = _first_zero(marks) * _step_s()
            self._meetings(track, ready, frozen, marks)
            delay = _first_zero(marks)
            if best is None or price + delay * _step_s() < best[0]:
                slot = Slot(out, home, (ready + delay) * _step_s(), flight)
                best = (price + delay * _step_s(), slot, track, ready + delay)
        assert best is not None
        self._tracks.append((best[3], best[2]))
        return best[1]

    def _frozen(self, home: Array) -> list[_Frozen]:
        """The placed samples around a start shared with a vehicle at home, and all others."""
        if not self._tracks:
            return []
        points = np.concatenate([t.places for _, t in self._tracks])
        pad = np.concatenate([t.pad & self._shared(t.home, home) for _, t in self._tracks])
        when = np.concatenate([s + t.ground + np.arange(len(t.places)) for s, t in self._tracks])
        kinds = ((False, ~pad), (True, pad))
        return [_Frozen.of(near, points[w], when[w], self._reach) for near, w in kinds if w.any()]

    def _launches(self, track: _Track, ready: int) -> NDArray[np.int64]:
        """Delays that takeoffs from the same start forbid, as marks; room for all others."""
        apart = self._apart
        slack, gap = (
            int(np.ceil(apart.slack_s / _step_s())),
            int(np.ceil(apart.launch_s / _step_s())),
        )
        end = max((s + t.ground + len(t.places) for s, t in self._tracks), default=0)
        marks = np.zeros(max(1, end - ready) + slack + gap + 3, np.int64)
        for start, other in self._tracks:
            if self._shared(other.home, track.home):
                _mark(marks, start - ready, gap - 1)
        return marks

    def _shared(self, home: Array, other: Array) -> bool:
        """Two places of takeoff count as one start."""
        return bool(np.hypot(*(home - other)) < active().planning.pad_distances * self._apart.distance_m)

    def _meetings(self, track: _Track, ready: int, frozen: list[_Frozen], marks: NDArray[np.int64]) -> None:
        """Mark delays that bring a track too near a placed one, or to the same start at the same time."""
        apart = self._apart
        # Layers are apart: the hair keeps neighbouring ones from clashing by rounding.
        limits, at_pad = (
            np.array([self._reach, apart.height_m - 0.01, np.ceil(slack_s / _step_s())])
            for slack_s in (apart.slack_s, apart.pad_slack_s)
        )
        when = ready + track.ground + np.arange(len(track.places))
        for other in frozen:
            away = ~track.pad if other.pad else np.ones(len(when), bool)
            other.forbid(track.places[away], when[away], limits, marks)
            if self._in_turn:
                other.forbid(track.places[~away], when[~away], at_pad, marks)
        for start, placed in self._tracks:
            if self._shared(placed.home, track.home):
                landing = start + placed.ground + len(placed.places) - track.ground - len(track.places)
                _mark(marks, landing - ready, int(np.ceil(apart.launch_s / _step_s())) - 1)


def _mark(marks: NDArray[np.int64], delay: int, slack: int) -> None:
    first, last = max(0, delay - slack), min(len(marks) - 2, delay + slack)
    if last >= first:
        marks[first] += 1
        marks[last + 1] -= 1


def _first_zero(marks: NDArray[np.int64]) -> int:
    return int(np.argmax(np.cumsum(marks) == 0))


def separate(sorties: Sequence[Sequence[Maker]], motions: Sequence[Motion], apart: Separation) -> Schedule:
    """Layers and takeoff times for all sorties of all vehicles.

    Args:
        sorties: per vehicle and sortie, what makes its flight with the way out, and the way home, so many metres
            higher than the legs.
        motions: say where each vehicle is when.
        apart: the distances to keep.
    """
    in_turn = _separate(sorties, motions, apart, in_turn=True)
    homes = [row[0].flight.home for row in in_turn]
    pad_m = active().planning.pad_distances * apart.distance_m
    if all(np.hypot(*(a - b)) >= pad_m for k, a in enumerate(homes) for b in homes[:k]):
        return Schedule(in_turn)
    at_once = _separate(sorties, motions, apart, in_turn=False)
    done, sooner = (_done_s(slots, motions) for slots in (in_turn, at_once))
    if done <= (1.0 + active().planning.in_turn_share) * sooner:
        return Schedule(in_turn)
    return Schedule(at_once, in_turn=False, saved_s=done - sooner)


def _done_s(slots: list[list[Slot]], motions: Sequence[Motion]) -> float:
    last = [(row[-1], motion) for row, motion in zip(slots, motions, strict=True)]
    return max(slot.start_s + slot.flight.time_s(motion) for slot, motion in last)


def _separate(
    sorties: Sequence[Sequence[Maker]], motions: Sequence[Motion], apart: Separation, *, in_turn: bool
) -> list[list[Slot]]:
    sky = _Sky(max(motion.speed_m_s for motion in motions), apart, in_turn)
    result: list[list[Slot]] = [[] for _ in sorties]
    ready = [0.0] * len(sorties)
    for turn in range(max(map(len, sorties))):
        due = {v: ready[v] + row[turn](0.0, 0.0).time_s(motions[v]) for v, row in enumerate(sorties) if turn < len(row)}
        for vehicle in sorted(due, key=lambda v: -due[v]):  # a delay hurts least where there is time left: it goes last
            slot = sky.place(sorties[vehicle][turn], motions[vehicle], ready[vehicle])
            result[vehicle].append(slot)
            ready[vehicle] = slot.start_s + slot.flight.time_s(motions[vehicle]) + apart.swap_s
    return result

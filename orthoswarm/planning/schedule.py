"""Keeping vehicles apart: heights for the ways out and home, and times of takeoff.

Vehicles are placed one after the other. Each takes the earliest takeoff, and then the lowest layer for its ways out
and home, at which it stays apart from all placed before: at any moment, and a few seconds earlier or later, either
far enough away or at another height. Enough delay always helps, so this ends.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.kernels import kernel
from orthoswarm.planning.flights import Flight
from orthoswarm.planning.motion import Motion

Array = NDArray[np.float64]

_STEP_S = 0.5
_GROUND_M = 2.0


@dataclass(frozen=True, slots=True)
class Separation:
    """How far apart vehicles stay.

    Attributes:
        distance_m: horizontally, or
        height_m: vertically, the height of a layer.
        layers: how many layers there are above the legs' height.
        slack_s: how much earlier or later than planned a vehicle may be.
        swap_s: time on the ground between a vehicle's sorties.
    """

    distance_m: float = 10.0
    height_m: float = 5.0
    layers: int = 4
    slack_s: float = 3.0
    swap_s: float = 120.0


@dataclass(frozen=True)
class Slot:
    """What a sortie was given: its layer (0 = the legs' height) and its takeoff, seconds after the swarm's start."""

    layer: int
    start_s: float
    flight: Flight


@kernel
def _clash(mine, begin, track, starts, offsets, boxes, distance, height, slack):  # type: ignore[no-untyped-def]
    """Does a sampled track (n, 3), beginning at sample `begin`, come too near one of those placed?

    Returns the sample from which on the clash with that one cannot recur, or -1 where all is well.
    """
    x0, x1 = mine[:, 0].min() - distance, mine[:, 0].max() + distance
    y0, y1 = mine[:, 1].min() - distance, mine[:, 1].max() + distance
    for k in range(len(starts)):
        first, count = offsets[k], offsets[k + 1] - offsets[k]
        if boxes[k, 0] > x1 or boxes[k, 2] < x0 or boxes[k, 1] > y1 or boxes[k, 3] < y0:
            continue
        low = max(0, starts[k] - slack - begin)
        high = min(len(mine), starts[k] + count + slack - begin)
        for i in range(low, high):
            at = begin + i - starts[k]
            for j in range(max(0, at - slack), min(count, at + slack + 1)):
                dx, dy = mine[i, 0] - track[first + j, 0], mine[i, 1] - track[first + j, 1]
                if dx * dx + dy * dy < distance * distance and abs(mine[i, 2] - track[first + j, 2]) < height:
                    return k
    return -1


def _sampled(flight: Flight, motion: Motion) -> tuple[int, Array]:
    """Positions every half second in the air: the number of samples on the ground before, and float64 (n, 3)."""
    track = flight.track()
    times = motion.times(track)
    moments = np.arange(0.0, times[-1] + _STEP_S, _STEP_S)
    places = np.stack([np.interp(moments, times, track[:, axis]) for axis in range(3)], axis=1)
    flying = np.flatnonzero(places[:, 2] > _GROUND_M)
    return int(flying[0]), np.ascontiguousarray(places[flying[0] : flying[-1] + 1])


def separate(
    sorties: Sequence[Sequence[Callable[[float], Flight]]], motion: Motion, apart: Separation
) -> list[list[Slot]]:
    """Layers and takeoff times for all sorties of all vehicles.

    Args:
        sorties: per vehicle and sortie, what makes its flight with the ways out and home a number of metres higher.
        motion: says where a vehicle is when.
        apart: the distances to keep.

    Returns:
        The same structure with layer, start and flight.
    """
    result: list[list[Slot]] = [[] for _ in sorties]
    ready = [0.0] * len(sorties)
    placed: list[tuple[int, Array]] = []
    slack = int(np.ceil(apart.slack_s / _STEP_S))
    for turn in range(max(map(len, sorties))):
        flights = {v: row[turn](0.0) for v, row in enumerate(sorties) if turn < len(row)}
        # The longest first: a delay hurts the makespan least where there is time left.
        for vehicle in sorted(flights, key=lambda v: -(ready[v] + flights[v].time_s(motion))):
            options = [(0, flights[vehicle], *_sampled(flights[vehicle], motion))]
            slot, begin, places = _first_free(
                sorties[vehicle][turn], options, ready[vehicle], placed, motion, apart, slack
            )
            placed.append((begin, places))
            result[vehicle].append(slot)
            ready[vehicle] = slot.start_s + slot.flight.time_s(motion) + apart.swap_s
    return result


def _first_free(
    make: Callable[[float], Flight],
    options: list[tuple[int, Flight, int, Array]],
    ready_s: float,
    placed: list[tuple[int, Array]],
    motion: Motion,
    apart: Separation,
    slack: int,
) -> tuple[Slot, int, Array]:
    others = np.concatenate([p for _, p in placed]) if placed else np.empty((0, 3))
    starts = np.array([b for b, _ in placed], np.int64)
    offsets = np.cumsum([0, *[len(p) for _, p in placed]])
    boxes = np.array([[*p[:, :2].min(0), *p[:, :2].max(0)] for _, p in placed]).reshape(-1, 4)
    delay = 0.0
    while True:
        for layer in range(apart.layers + 1):
            if layer >= len(options):
                flight = make(layer * apart.height_m)
                options.append((layer, flight, *_sampled(flight, motion)))
            _, flight, ground, places = options[layer]
            begin = int(np.ceil((ready_s + delay) / _STEP_S)) + ground
            # Layers count as apart although climbing rounds a sample: the hair keeps equal heights in conflict only.
            near = _clash(places, begin, others, starts, offsets, boxes, apart.distance_m, apart.height_m - 0.01, slack)
            if near < 0:
                return Slot(layer, (begin - ground) * _STEP_S, flight), begin, places
        delay += 2.0 if delay < 120.0 else 0.05 * delay

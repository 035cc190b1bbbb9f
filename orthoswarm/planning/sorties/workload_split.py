"""Sharing a row of legs among vehicles, and a vehicle's legs among sorties, evenly.

The row is cut into consecutive pieces, as MSTC* does with its round trip (Tang, Sun, Zhang 2021, TMSTC* section V).
Dynamic programming over possible cuts makes the longest piece, ways out and home included, as short as can be; then,
hardly longer than that, pieces even and legs whole.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.compute.jit import kernel
from orthoswarm.model.arrays import Array, Indices
from orthoswarm.planning.lines.detours import Router
from orthoswarm.planning.sorties.flight_time import Motion, angles

_FIRST_CAP: Final = 1.3
"""Divisions are searched up to so many times the mean share first, which keeps the search narrow ..."""
_CAP_GROWTH: Final = 1.5  # ... then up to so many times more ...
_CAPS: Final = 8  # ... so often, and at last without a limit
_CUT_PRICE: Final = 0.25  # price of a cut within a leg, in the unit of what is divided
_LEEWAY: Final = 1.04  # how much longer than it must be the longest share may get so that legs stay whole
_CUTS_PER_SHARE: Final = 24  # possible cuts in a share (for its time)


@dataclass(frozen=True)
class Row:
    """Legs in flying order, cut at every place where a piece may end."""

    parts: Array  # float64 (n, 2, 2), straight parts of legs
    leg: Indices  # int64 (n,), the leg that each part belongs to
    begin_s: Array  # float64 (n,), time at which each part begins when the whole row is flown; end_s when it ends
    end_s: Array  # float64 (n,)

    def legs(self, begin: int, end: int) -> Array:
        """Parts begin to end - 1 put together to legs again: float64 (m, 2, 2)."""
        leg = self.leg[begin:end]
        first = np.flatnonzero(np.diff(leg, prepend=leg[0] - 1))
        last = np.append(first[1:], len(leg)) - 1
        return np.stack([self.parts[begin:end][first, 0], self.parts[begin:end][last, 1]], axis=1)


def cut(
    legs: Array, router: Router, motion: Motion, *, shares: int, least_m: float, step_m: float | None = None
) -> Row:
    """A row of legs with places to cut.

    Args:
        legs: float64 (n, 2, 2) in flying order. router: measures the ways between legs. motion: gives times.
        shares: into how many pieces the row is meant to be cut. least_m: shortest part of a leg.
        step_m: longest part; by default a small fraction of a share.
    """
    length = np.hypot(*(legs[:, 1] - legs[:, 0]).T)
    step = max(least_m, length.sum() / shares / _CUTS_PER_SHARE if step_m is None else step_m)
    count = np.maximum(1, (length / step).astype(np.int64))
    leg = np.repeat(np.arange(len(legs)), count)
    at = np.arange(len(leg)) - np.repeat(np.cumsum(count) - count, count)
    low, high = (at / count[leg])[:, None], ((at + 1) / count[leg])[:, None]
    start, span = legs[leg, 0], legs[leg, 1] - legs[leg, 0]
    parts = np.stack([start + low * span, start + high * span], axis=1)
    parts[at == 0, 0], parts[at == count[leg] - 1, 1] = legs[:, 0], legs[:, 1]
    way_s = np.zeros(len(parts))
    if len(legs) > 1:
        ways = router.each(legs[:-1, 1], legs[1:, 0]) / motion.even_speed_m_s
        for k in range(len(legs) - 1):
            ways[k] += motion.turn_s(angles(legs[k : k + 2].reshape(4, 2))).sum()
        way_s[np.flatnonzero(at == 0)[1:]] = ways
    part_s = np.hypot(*(parts[:, 1] - parts[:, 0]).T) / motion.even_speed_m_s
    end_s = np.cumsum(way_s + part_s)
    return Row(parts, leg, end_s - part_s, end_s)


@dataclass(frozen=True)
class Limits:
    """What a single flight may cost."""

    # longest flight, one for all vehicles or float64 (vehicles,); infinite without a limit
    endurance_s: float | Array = np.inf
    fixed_s: float = 0.0  # climb and descent, in every flight
    swap_s: float = 0.0  # time on the ground between flights
    most_legs: int = 1_000_000  # legs that one mission can hold


@kernel
def _cut_evenly(parts, leg, when, out, home, own, single, back, endurance, limits, cut_price, cap, shortest):  # type: ignore[no-untyped-def]
    """Cuts (vehicles + 1,) of the row, [0] is -1 where no cut keeps within the limits; and the longest piece's time.

    when[k]: seconds at which part k begins and ends; out[j, p] and home[j, q]: seconds from vehicle j's start to part
    p, and from part q back; endurance[j]: its longest flight; limits: fixed time, time between flights, most legs.
    With `own`, the start is where the piece begins and `back` the seconds per metre of the way home. With `single`, a
    piece is one flight. No piece takes longer than `cap`. With `shortest` the longest piece is as short as can be;
    else the sum of the sixth powers of times over `cap`, and of a price per cut within a leg, is least.
    """
    fixed, swap, most = limits
    vehicles, n = out.shape[0], len(leg)
    cost = np.full((vehicles + 1, n + 1), np.inf)
    prior = np.full((vehicles + 1, n + 1), -1, np.int64)
    cost[0, 0] = 0.0
    longest_way = 0.0  # ways between pieces are nobody's work
    for k in range(1, n):
        longest_way = max(longest_way, when[k, 0] - when[k - 1, 1])
    for j in range(vehicles):
        for q in range(j + 1, n - (vehicles - j - 1) + 1):
            done, left = when[q - 1, 1] - when[0, 0], when[n - 1, 1] - when[q - 1, 1]
            if done > (j + 1) * (cap + longest_way) or (q < n and left > (vehicles - j - 1) * (cap + longest_way)):
                continue
            price = cut_price if q < n and leg[q] == leg[q - 1] else 0.0
            for p in range(q - 1, j - 1, -1):
                work = when[q - 1, 1] - when[p, 0]
                if work > cap or (shortest and work >= cost[j + 1, q]):
                    break  # longer pieces only get worse
                if cost[j, p] == np.inf:
                    continue
                if own:
                    away = parts[q - 1, 1] - parts[p, 0]
                    way = back * np.hypot(away[0], away[1])
                else:
                    way = out[j, p] + home[j, q - 1]
                legs, room, flights = leg[q - 1] - leg[p] + 1, endurance[j] - fixed - way, 1.0
                if single:
                    if work > room or legs > most:
                        continue
                elif room <= 0.0:
                    continue
                else:
                    flights = max(1.0, np.ceil(legs / most), np.ceil(work / room))
                time = work + flights * way + (flights - 1.0) * (fixed + swap)  # what all pay alike is left out
                if time > cap:
                    continue
                if shortest:
                    total = max(cost[j, p], time)
                else:
                    cube = (time / cap) ** 3
                    total = cost[j, p] + cube * cube + price
                if total < cost[j + 1, q]:
                    cost[j + 1, q] = total
                    prior[j + 1, q] = p
    cuts = np.full(vehicles + 1, -1, np.int64)
    if cost[vehicles, n] < np.inf:
        cuts[vehicles] = n
        for j in range(vehicles, 0, -1):
            cuts[j - 1] = prior[j, cuts[j]]
    return cuts, cost[vehicles, n]


def _evenly(
    row: Row, out: Array, home: Array, motion: Motion, limits: Limits, *, own: bool, returns: bool, single: bool
) -> Indices | None:
    problem = (
        np.ascontiguousarray(row.parts),
        row.leg,
        np.stack([row.begin_s, row.end_s], axis=1),
        np.ascontiguousarray(out),
        np.ascontiguousarray(home),
        own,
        single,
        1.0 / motion.even_speed_m_s if returns else 0.0,
        np.array(np.broadcast_to(np.asarray(limits.endurance_s, np.float64), len(out))),
        np.array([limits.fixed_s, limits.swap_s, limits.most_legs], np.float64),
    )
    # A cap that is met keeps the search narrow, so try small ones first.
    share_s = (row.end_s[-1] - row.begin_s[0]) / len(out)
    for cap in (*(share_s * _FIRST_CAP * _CAP_GROWTH ** np.arange(_CAPS)), np.inf):
        cuts, longest = _cut_evenly(*problem, _CUT_PRICE, cap, True)
        if cuts[0] >= 0:
            return np.asarray(_cut_evenly(*problem, _CUT_PRICE, _LEEWAY * longest + 1e-6, False)[0])
    return None


def _pairs(cuts: Indices) -> list[tuple[int, int]]:
    return list(itertools.pairwise(cuts.tolist()))


def share(
    row: Row, vehicles: int, starts: Array | None, *, returns: bool, router: Router, motion: Motion, limits: Limits
) -> list[tuple[int, int]] | None:
    """Which parts each vehicle flies: begin and end (exclusive) per vehicle; None where the limits allow no way.

    Args:
        row: the legs with places to cut. vehicles: how many.
        starts: float64 (vehicles, 2), each vehicle's start; None puts it where its piece begins.
        returns: vehicles fly back to their start. router: measures the ways out and home. motion: gives times.
        limits: of a single flight; a piece may take several.
    """
    nothing = np.zeros((vehicles, len(row.parts)))
    if starts is None:
        cuts = _evenly(row, nothing, nothing, motion, limits, own=True, returns=returns, single=False)
        return None if cuts is None else _pairs(cuts)
    places, kind = np.unique(starts, axis=0, return_inverse=True)
    kind = kind.reshape(-1)
    out = router.distances(places, row.parts[:, 0]) / motion.even_speed_m_s
    home = router.distances(places, row.parts[:, 1]) / motion.even_speed_m_s * returns
    order = np.arange(vehicles)
    if len(places) > 1:  # who flies which piece: first cut without ways, then the cheapest assignment
        free = Limits(swap_s=limits.swap_s)
        cuts = _evenly(row, nothing, nothing, motion, free, own=False, returns=returns, single=False)
        if cuts is None:
            return None
        from scipy.optimize import linear_sum_assignment  # not at the start of a station, which it holds up

        ways = out[kind][:, cuts[:-1]] + home[kind][:, cuts[1:] - 1]
        who, piece = linear_sum_assignment(ways)
        order[piece] = who
    ordered = replace(limits, endurance_s=np.broadcast_to(limits.endurance_s, vehicles)[order])
    cuts = _evenly(row, out[kind][order], home[kind][order], motion, ordered, own=False, returns=returns, single=False)
    if cuts is None:
        return None
    result = [(0, 0)] * vehicles
    for place, vehicle in enumerate(order):
        result[vehicle] = (int(cuts[place]), int(cuts[place + 1]))
    return result


def sorties(
    row: Row, start: Array, returns: bool, *, router: Router, motion: Motion, limits: Limits
) -> list[tuple[int, int]] | None:
    """Fewest flights from one start that fly a whole row within the limits, evenly cut; None where there is no way.

    Args:
        row: one vehicle's legs with places to cut. start: float64 (2,). returns: each flight goes back to the start.
        router: measures the ways out and home. motion: gives times. limits: of each flight; one endurance.
    """
    out = router.distances(start, row.parts[:, 0]) / motion.even_speed_m_s
    home = router.distances(start, row.parts[:, 1]) / motion.even_speed_m_s * returns
    begin, count = 0, 0
    while begin < len(row.parts):  # as far as one flight goes, again and again: how many it takes at least
        ways = out[0, begin] + home[0, begin:] + limits.fixed_s
        legs = row.leg[begin:] - row.leg[begin] + 1
        works = row.end_s[begin:] - row.begin_s[begin]
        reached = np.flatnonzero((works + ways <= limits.endurance_s) & (legs <= limits.most_legs))
        if not len(reached):
            return None
        begin, count = begin + int(reached[-1]) + 1, count + 1
    if count == 1:
        return [(0, len(row.parts))]
    for flights in range(count, min(count + 4, len(row.parts)) + 1):
        cuts = _evenly(
            row, np.repeat(out, flights, 0), np.repeat(home, flights, 0), motion, limits, own=False, returns=returns,
            single=True,
        )  # fmt: skip
        if cuts is not None:
            return _pairs(cuts)
    return None

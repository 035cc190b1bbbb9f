"""The lines that a method lays over an area, in the few directions that promise most."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal, get_args

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.planning.lines import planned_coverage
from orthoswarm.planning.lines.bcd import bcd_legs
from orthoswarm.planning.lines.detours import Router
from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.lines.sweep_lines import Field, Turned, lines_across, rank_directions, stretches
from orthoswarm.planning.lines.tmstc import tmstc_legs
from orthoswarm.planning.lines.visiting_order import shorten

Method = Literal["columns", "bcd", "tmstc"]

METHODS: tuple[str, ...] = get_args(Method)
_TRIES: dict[str, int] = {"columns": 6, "bcd": 6, "tmstc": 8}
_SAME_GRID_RAD: Final = 0.02  # grids of the spanning tree nearer to each other are tried once
_TRIES_IF_FEW: Final = 12  # directions tried where lines are few: cheap to lay, hard to share
_MANY_LEGS: Final = 400  # from so many legs on no further directions are tried: they hardly differ (for its time)
_DENSER: Final = 1.25  # closer lines are tried up to so many times their number, to share evenly
_HOPELESS: Final = 1.08  # gaps are not filled for a direction whose path is so many times as long as the best


@dataclass(frozen=True)
class LineCandidate:
    """One way to lay lines."""

    legs: Array  # float64 (n, 2, 2) in flying order, grid metres, gaps mended
    stretches: int  # among how many vehicles the legs, without those that mend gaps, can be shared

    def then(self, other: "LineCandidate") -> "LineCandidate":
        """The lines of this one, and then those of another, from the end that is nearer."""
        back = other.legs[::-1, ::-1]
        far, near = (float(np.hypot(*(legs[0, 0] - self.legs[-1, 1]))) for legs in (other.legs, back))
        legs = np.concatenate([self.legs, back if near < far else other.legs])
        return LineCandidate(legs, self.stretches + other.stretches)


def candidates(
    field: Field,
    vehicles: int,
    foot: Footprint,
    *,
    method: Method,
    turn_m: float,
    router: Router,
    reach_m: float,
    sweep_rad: float | None = None,
    cross: bool = False,
) -> Iterator[LineCandidate]:
    """Ways to lay lines, the most promising directions first; none where the area is all within obstacles.

    Args:
        field: ground and obstacles, grid metres.
        vehicles: where few lines are shared by many vehicles, a multiple of them shares out more evenly.
        foot: footprint of the narrowest camera. method: how to lay and order lines.
        turn_m: what a turn costs, in metres. router: measures ways around obstacles.
        reach_m: how far pictures count beyond a leg's ends when looking for gaps.
        sweep_rad: direction of the sweep, across the lines, from grid east, counter-clockwise; None to try several.
        cross: each is followed by lines across its own.
    """
    angles = rank_directions(field, foot, turn_m, vehicles) if sweep_rad is None else [sweep_rad]
    if cross:
        lay = partial(candidates, field, vehicles, foot, method=method, turn_m=turn_m, router=router, reach_m=reach_m)
        for angle in angles[: _TRIES[method]]:
            across = next(lay(sweep_rad=angle + 0.5 * np.pi), None)
            yield from (one.then(across) for one in lay(sweep_rad=angle) if across is not None)
        return
    if method == "tmstc":  # a grid looks the same after a right angle
        quarter = [a % (0.5 * np.pi) for a in angles]
        angles = [a for k, a in enumerate(quarter) if not any(abs(a - b) < _SAME_GRID_RAD for b in quarter[:k])]
    few, least = False, np.inf
    for number, angle in enumerate(angles):
        if number >= (_TRIES_IF_FEW if few else _TRIES[method]):
            return
        legs = _lay(field, angle, foot, method=method, router=router, multiple=1)
        if not len(legs):
            continue
        lengths = np.hypot(*(legs[:, 1] - legs[:, 0]).T)
        count = stretches(lengths, foot.spacing_m)
        few = few or count < 4 * vehicles
        ways = np.hypot(*(legs[1:, 0] - legs[:-1, 1]).T).sum()  # no-fly zones between legs left out
        rough = float(lengths.sum() + ways + turn_m * len(legs))
        least = min(least, rough)
        if not few and rough > _HOPELESS * least:
            continue
        yield from _finished(field, legs, count, angle=angle, foot=foot, method=method, router=router, reach_m=reach_m)
        if len(legs) > _MANY_LEGS:  # directions hardly differ then, and each takes its time
            return
        if method != "tmstc" and vehicles <= len(legs) < 4 * vehicles:
            denser = _lay(field, angle, foot, method=method, router=router, multiple=vehicles)
            if len(legs) < len(denser) <= _DENSER * len(legs):
                yield from _finished(
                    field, denser, count, angle=angle, foot=foot, method=method, router=router, reach_m=reach_m
                )


def _lay(field: Field, angle: float, foot: Footprint, *, method: Method, router: Router, multiple: int) -> Array:
    if method == "columns":
        return column_legs(field, angle, foot, multiple)
    if method == "bcd":
        return planned_coverage.prune(field, bcd_legs(field, angle, foot, router, multiple), foot)
    return planned_coverage.prune(field, chained(tmstc_legs(field, angle, foot)), foot)


def column_legs(field: Field, angle_rad: float, foot: Footprint, multiple: int = 1) -> Array:
    """Legs of all columns over the area in flying order, float64 (n, 2, 2), grid metres; arguments as of `bcd_legs`.

    A column that an obstacle or a bay of the outline interrupts is flown to its end (around the obstacle) before the
    next one begins: simple and even, but it goes around an obstacle once per column.
    """
    frame = Turned(angle_rad, (field.ground.centroid.x, field.ground.centroid.y))
    found: list[Array] = []
    up = True
    for legs in lines_across(field.turned(frame), foot, multiple):
        found += legs if up else [leg[::-1] for leg in reversed(legs)]
        up = up != bool(legs)
    return frame.to_grid(np.array(found)) if found else np.empty((0, 2, 2))


def _finished(
    field: Field,
    legs: Array,
    count: int,
    *,
    angle: float,
    foot: Footprint,
    method: Method,
    router: Router,
    reach_m: float,
) -> Iterator[LineCandidate]:
    """The legs without gaps, in the method's own order, and in the order of a local search."""
    mended = planned_coverage.mend(field, legs, foot, router=router, reach_m=reach_m, angle_rad=angle)
    yield LineCandidate(mended, count)
    if method != "columns":
        yield LineCandidate(shorten(mended, router), count)


def chained(loops: list[Array]) -> Array:
    """Closed rows of legs one after the other: the first opened at its widest gap, others near the one before.

    loops: float64 (n, 2, 2) each.
    """
    if not loops:
        return np.empty((0, 2, 2))
    first, *rest = loops
    gaps = np.hypot(*(first[:, 0] - np.roll(first[:, 1], 1, axis=0)).T)
    rows = [np.roll(first, -int(np.argmax(gaps)), axis=0)]
    while rest:
        here = rows[-1][-1, 1]
        near = [float(np.hypot(*(loop[:, 0] - here).T).min()) for loop in rest]
        loop = rest.pop(int(np.argmin(near)))
        rows.append(np.roll(loop, -int(np.argmin(np.hypot(*(loop[:, 0] - here).T))), axis=0))
    return np.concatenate(rows)

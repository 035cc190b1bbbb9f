"""Which items of a mission a vehicle has reached: by its own word, or because it was seen there.

MISSION_CURRENT alone does not tell: another station may set any item current, and the autopilot then completes a
mission of which it has flown a part. MISSION_ITEM_REACHED may be lost, and PX4 leaves some out, so a place counts as
well. What was not seen because the link was silent counts as reached as far as it can have flown meanwhile.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from gcs_plugin.mission.items import LANDINGS, TAKEOFFS, TRIGGER_DISTANCE, Mission
from gcs_plugin.mission.track import home_of, metres

_CLAIMED_M: Final = 30.0  # corners are rounded by less than that
_NEAR_M: Final = 15.0  # autopilots round corners by up to 10 m (PX4's NAV_ACC_RAD), receivers err by some metres
_SILENT_S: Final = 2.0  # between two positions: what happened in between was not seen
_FASTEST_M_S: Final = 25.0  # no multirotor on a survey flies faster
_ENDS: Final = frozenset({*TAKEOFFS, *LANDINGS})


@dataclass(slots=True, kw_only=True)
class FlownItems:
    """The places of one mission, and which of them were reached.

    Attributes:
        places: item -> latitude and longitude in degrees, of those that are flown between takeoff and landing.
        lines: items that end a line on which pictures are taken; without a camera's trigger, all places.
    """

    places: dict[int, tuple[float, float]]
    lines: list[int]
    reached: set[int] = field(default_factory=set)
    _seq: int | None = None
    _here: tuple[float, float] | None = None
    _at_s: float | None = None
    _unseen_m: float = 0.0
    _skipped: int | None = None
    _from: tuple[float, float] | None = None
    _claimed: list[int] = field(default_factory=list)
    _passed: set[int] = field(default_factory=set)

    @classmethod
    def of(cls, mission: Mission) -> "FlownItems":
        """None of a mission's items reached."""
        places, lines, triggers = dict[int, tuple[float, float]](), list[int](), False
        for seq, item in enumerate(mission.items[mission.first_seq :], mission.first_seq):
            if item.is_nav and item.has_place and item.command not in _ENDS and item.place is not None:
                places[seq] = item.place
                lines += [seq] if triggers else []
            elif item.command == TRIGGER_DISTANCE:
                triggers = item.params[0] > 0.0
        return cls(places=places, lines=lines or list(places))

    def position(self, time_s: float, lat_deg: float, lon_deg: float, *, counts: bool = True) -> bool:
        """It was seen at a place, at a time of its own clock; while it is paused that does not count as reached.

        Returns whether it says that it has reached a place that it is far from: then it flies another mission.
        """
        silent_s = 0.0 if self._at_s is None else time_s - self._at_s
        self._unseen_m = silent_s * _FASTEST_M_S if silent_s > _SILENT_S else self._unseen_m
        if silent_s > _SILENT_S:
            self._excuse()
        self._at_s, self._here = time_s, (lat_deg, lon_deg)
        if not counts:
            return False
        reach_m = _CLAIMED_M + (silent_s * _FASTEST_M_S if silent_s > _SILENT_S else 0.0)  # it has flown on since
        near = {s for s in self._claimed if s not in self.places or _metres(self._here, self.places[s]) < reach_m}
        elsewhere, self._claimed = len(near) < len(set(self._claimed)), []
        self.reached |= near
        # Of places near each other it may pass several before the next MISSION_CURRENT is heard.
        self._passed.update(s for s, place in self.places.items() if _metres(self._here, place) < _NEAR_M)
        for seq in (s for s in (self._seq, self._before) if s is not None and s not in self.reached):
            if seq in self.places and _metres(self._here, self.places[seq]) < _NEAR_M:
                self.reached.add(seq)
        return elsewhere

    def claims(self, seq: int) -> None:
        """Its autopilot says that it has reached an item; its next position must not be far from there."""
        self._claimed.append(seq)

    def current(self, seq: int) -> None:
        """An item has become the present one."""
        last, self._seq = self._seq, seq
        if last is not None:
            self.reached.update(s for s in self._passed if last <= s < seq)
        self._passed.clear()
        if last is None:  # what it did before it was heard is not known
            self.reached.update(s for s in self.places if s < seq)
        elif any(last <= s < seq and s not in self.reached for s in self.places):
            self._skipped, self._from = last, self._here if self._skipped is None else self._from
            self._excuse()

    def ended(self) -> None:
        """Its autopilot says that the mission is complete."""
        if not self.all_reached:
            self._skipped = min(self._skipped or 0, self._seq or 0)
            self._from, self._seq = self._from or self._here, max(self.places) + 1
            self._excuse()

    def _excuse(self) -> None:
        """Count what it skipped as reached if it can have flown there while it was not heard."""
        first, here, way_m = self._skipped, self._from or self._here, 0.0
        skipped = [s for s in self.places if (first or 0) <= s < (self._seq or 0) and s not in self.reached]
        if first is None or not skipped or here is None:
            return
        for s in skipped:
            way_m, here = way_m + _metres(here, self.places[s]), self.places[s]
        if way_m <= self._unseen_m:
            self.reached.update(skipped)
            self._unseen_m, self._skipped, self._from = self._unseen_m - way_m, None, None

    @property
    def all_reached(self) -> bool:
        """Whether every place was."""
        return self.places.keys() <= self.reached

    @property
    def text(self) -> str:
        """How much was flown, in words."""
        return f"{len(self.reached & set(self.lines))} of {len(self.lines)} lines flown"

    @property
    def _before(self) -> int | None:
        """The place before the present item: MISSION_CURRENT may be ahead of the position."""
        return None if self._seq is None else max((s for s in self.places if s < (self._seq or 0)), default=None)

    def state(self) -> dict[str, Any]:
        """As JSON values."""
        places = [[seq, *place] for seq, place in self.places.items()]
        return asdict(self) | {"places": places, "reached": sorted(self.reached), "_passed": sorted(self._passed)}

    @classmethod
    def from_state(cls, values: Mapping[str, Any]) -> "FlownItems":
        """What `state` described."""
        spots = {key: tuple(values[key]) if values[key] else None for key in ("_here", "_from")}
        places = {int(s): (float(a), float(b)) for s, a, b in values["places"]}
        sets = {key: set(values.get(key, ())) for key in ("reached", "_passed")}
        return cls(**{**values, **spots, **sets, "places": places})


def off_leg_m(mission: Mission, seq: int, place: tuple[float, float]) -> float | None:
    """How far a place (degrees) is from the way to a mission's item, metres; None where the item has no place."""
    placed = {s: i.place for s, i in enumerate(mission.items) if i.is_nav and i.has_place}
    places = {s: spot for s, spot in placed.items() if spot is not None}
    takeoff = seq < len(mission) and mission.items[seq].command in TAKEOFFS
    end = home_of(mission) if takeoff else places.get(seq)
    if end is None:
        return None
    before = max((s for s in places if mission.first_seq <= s < seq), default=None)
    x1, y1 = metres(*(end if before is None or takeoff else places[before]), place)
    x2, y2 = metres(*end, place)
    along, length2 = -(x1 * (x2 - x1) + y1 * (y2 - y1)), (x2 - x1) ** 2 + (y2 - y1) ** 2
    share = min(1.0, max(0.0, along / length2)) if length2 else 0.0
    return math.hypot(x1 + share * (x2 - x1), y1 + share * (y2 - y1))


def _metres(one: tuple[float, float], other: tuple[float, float]) -> float:
    return math.hypot(*metres(*one, other))

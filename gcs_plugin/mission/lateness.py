"""How far a vehicle is behind the times of its mission, by where it is on its way.

Plans keep vehicles apart for some seconds off schedule (`schedule_slack_s`). One that is later than that, because of
wind, or a speed that it does not reach, is where others do not expect it.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from gcs_plugin.mission.track import STEP_S, Track, home_of, metres, track_of

if TYPE_CHECKING:
    from gcs_plugin.mission.items import Mission

_LIFTED_M: Final = (0.5, 5.0)
"""A flight begins as it is first seen between these heights over its takeoff; one seen higher is under way already."""
_AHEAD_S: Final = 30.0
"""How far ahead of the place where it was last its next place is looked for, seconds of its plan."""
_OFF_M: Final = 15.0
"""A vehicle that is farther from its way is not on it: it was paused, sent elsewhere, or blown off."""
_STANDS_S: Final = 3.0
"""Longer in one place a plan stands still; at the slowest of a turn it takes less for `_AS_NEAR_M` either way."""
_STILL_BEHIND: Final = 0.5
"""One that is behind is so until it is late by less than this share of what is allowed: words must not come and go."""
_AS_NEAR_M: Final = 1.0
"""Places so much farther than the nearest one count as well: where it stands still, many moments have one place."""


@dataclass(slots=True)
class Lateness:
    """One flight of a mission, compared with its times.

    Attributes:
        mission: what is flown.
        late_s: how far it is behind, seconds of its own clock; negative: ahead. Where its plan stands still, too, that
            is only known to be more than something, so what was known before stays.
        behind: True while it is later than plans allow for.
    """

    mission: "Mission"
    late_s: float = field(default=0.0, init=False)
    behind: bool = field(default=False, init=False)
    _track: Track | None = field(default=None, init=False)
    _home: tuple[float, float] = field(default=(0.0, 0.0), init=False)
    _begun_s: float | None = field(default=None, init=False)
    _at: int = field(default=0, init=False)
    _seen_m: float = field(default=float("inf"), init=False)

    def __post_init__(self) -> None:
        home = home_of(self.mission)
        if home is not None:
            self._home, self._track = home, track_of(self.mission, home)

    @property
    def allowed_s(self) -> float:
        """How late it may be, seconds."""
        return self._track.autopilot.schedule_slack_s if self._track is not None else float("inf")

    def look(self, time_s: float, lat_deg: float, lon_deg: float, height_m: float) -> None:
        """Compare a position.

        Args:
            time_s: on the vehicle's clock. lat_deg, lon_deg: where it is. height_m: over its takeoff.
        """
        track = self._track
        if track is None or len(track.places) < 2:
            return
        if self._begun_s is None:
            seen, self._seen_m = self._seen_m, height_m
            if seen < _LIFTED_M[0] <= height_m < _LIFTED_M[1]:
                self._begun_s = time_s - STEP_S * int(np.argmax(track.places[:, 2] >= height_m))
            return
        flown_s = time_s - self._begun_s
        window = track.places[self._at : self._at + round(_AHEAD_S / STEP_S) + 1]
        here = np.array([*metres(lat_deg, lon_deg, self._home), height_m])
        away = np.linalg.norm(window - here, axis=1)
        nearest = int(np.argmin(away))
        if away[nearest] < _OFF_M:
            far = np.flatnonzero(away > away[nearest] + _AS_NEAR_M)  # another leg beside this one does not count
            first = max(far[far < nearest], default=-1) + 1
            last = min(far[far > nearest], default=len(away)) - 1
            self._at += int(np.clip(round(flown_s / STEP_S) - self._at, first, last))
            late_s = flown_s - STEP_S * self._at
            self.late_s = max(self.late_s, late_s) if (last - first) * STEP_S > _STANDS_S else late_s
        else:
            self.late_s = flown_s - STEP_S * self._at
        self.behind = self.late_s > self.allowed_s * (_STILL_BEHIND if self.behind else 1.0)

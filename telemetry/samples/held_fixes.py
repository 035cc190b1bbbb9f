"""Fixes that a receiver held or foretold and did not measure: repeated, frozen, extrapolated, stale after a restart.

A receiver that measures wanders, even at rest. A fix that says exactly what those before it foretell (the same place,
or the same way further on) holds no news; it is believed as long as the next fix with news is where the vehicle can
have gone from it, at the speed it flies around that time. Otherwise the vehicle flew elsewhere meanwhile: such a fix
has no place but between those measured before and after, with the sigma of a way that nobody saw.
"""

from collections import Counter, deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.earth import DEGREE_M, MEAN_RADIUS_M, distance_m
from orthoswarm.model.frame import UNSTATED_SIGMA_M, Frame
from telemetry.samples.course import local_metres
from telemetry.samples.findings import Finding, metres, plural
from telemetry.samples.sample import Sample

LOST_SIGMA_M: Final = 20.0  # a place that is known no better is none: a picture would be drawn beside its ground
_NEWS_M: Final = 3.0  # shorter ways are a receiver's noise
_NEWS_QUANTA: Final = 3.0  # ... or so many steps of coarse coordinates
_COARSE_STEPS: Final = (1, 10, 60, 100, 600, 1000, 3600, 6000, 10_000, 36_000, 60_000, 100_000)
"""Steps of a degree in coarse coordinates, of a metre and more: decimals of degrees, minutes and seconds."""
_COARSE_LEAST: Final = 3  # fewer coordinates have few decimals by chance
_USUAL_REPEATS: Final = 3.0  # fixes are repeated at their own rate; those that are told last so many times longer ...
_SLOWEST_S: Final = 2.0  # ... or longer than this: no receiver of a vehicle measures less often
_FASTER: Final = 3.0  # so many times the speed around it, no way is flown
_LIKE: Final = 1.5  # ways flown agree with the speed around them within this factor
_FORETOLD_SHARE: Final = 0.3  # what is foretold is right to this share of what fixes of the same flight usually are
_FORETOLD_LEAST: Final = 3  # by chance fewer fixes in a row are foretold
_ONE_FIX_SHARE: Final = 0.8  # ... or this share of a flight's
_ONE_FIX_LEAST: Final = 5  # fewer photos may be taken while a receiver with a filter stands still
_FORETOLD_LONGEST_S: Final = 30.0  # receivers foretell for so long
_TURN_M_S2: Final = 3.0  # acceleration in turns of small drones: a way bends away from its chord by it
_STRAIGHT_SHARE: Final = (
    0.8  # ... unless the chord is shorter than this share of the way: then it turned back meanwhile
)
_ASTRAY_SHARE: Final = 0.6  # sigma of a way that nobody saw, to the next measured fix: a right angle is 1.5 of it off
_FASTEST_M_S: Final = 100.0  # steps of times that were rounded to one second
_LEAST_M_S: Final = 0.1  # no vehicle is quite at rest
_AROUND: Final = 3  # steps before and after by which the speed around a fix is told


@dataclass(frozen=True, slots=True)
class HeldFixes:
    """Fixes (H of them) that were not measured."""

    index: list[int]  # of each in the caller's order
    # lat_deg, lon_deg: float64 (H,), between the measured ones, or the nearest one
    lat_deg: Array
    lon_deg: Array
    sigma_m: Array  # float64 (H,), one sigma of that
    longest_s: float = 0.0  # the longest time without a measured fix

    def __len__(self) -> int:
        return len(self.index)

    def each(self) -> Iterator[tuple[int, float, float, float]]:
        """Index, latitude, longitude and sigma of one after the other."""
        return zip(self.index, self.lat_deg.tolist(), self.lon_deg.tolist(), self.sigma_m.tolist(), strict=True)

    def finding(self, of_what: str, *, void: bool = False) -> Finding:
        """What is said about them; of_what: whose they are. void: whether the receiver itself calls some so."""
        lost = int((self.sigma_m > LOST_SIGMA_M).sum())
        kept = len(self) - lost
        parts = [f"{kept} lie between those before and after (sigma up to {metres(self.told_m)})"] if kept else []
        parts += [f"{lost} are not used, as nothing tells where these were"] if lost else []
        what = "repeat or foretell others although the vehicle flew on"
        what = f"are void by the receiver's own word (GPSStatus V) or {what}" if void else what
        why = "the receiver stood still or had no fix" if void else "the receiver stood still"
        text = (
            f"{plural(len(self), 'position')} of {of_what} {what}, for up to {self.longest_s:.0f} s: {why}; "
            f"{', '.join(parts)}"
        )
        return Finding("position-held", text)

    @property
    def told_m(self) -> float:
        """The largest sigma of those that have a place."""
        return float(self.sigma_m[self.sigma_m <= LOST_SIGMA_M].max(initial=0.0))


def held_fixes(
    times_s: Sequence[float | None], places: Sequence[tuple[float, float]], void: Collection[int] = ()
) -> HeldFixes:
    """The fixes of a flight that were not measured, and where the vehicle was.

    times_s: of the fixes, in one clock; what has none is not judged. places: latitude and longitude in degrees.
    void: indices of those that were not measured by the receiver's own word.
    """
    order = sorted((i for i, t in enumerate(times_s) if t is not None and t == t), key=lambda i: times_s[i] or 0.0)
    none = np.zeros(0)
    own = np.flatnonzero([i not in void for i in order])
    if len(own) < _FORETOLD_LEAST:
        return HeldFixes([], none, none, none)
    times = np.array([times_s[i] for i in order], dtype=np.float64)
    ground = local_metres([places[i][0] for i in order], [places[i][1] for i in order])
    news_m = max(_NEWS_M, _NEWS_QUANTA * _quantum_m(np.array([places[order[i]] for i in own])))
    pace = _over(np.hypot(*np.diff(ground[own], axis=0).T), np.diff(times[own]))
    speed = np.full(len(order), np.clip(np.median(pace), _LEAST_M_S, _FASTEST_M_S))  # 0 below where it was measured
    marks = np.zeros(len(own))
    _mark_repeated(times[own], ground[own], marks, news_m)
    _mark_foretold(times[own], ground[own], marks, news_m)
    speed[own] = marks
    held, news = np.flatnonzero(speed > 0.0), np.flatnonzero(speed == 0.0)
    if not len(held) or not len(news):
        return HeldFixes([], none, none, none)
    right = np.searchsorted(news, held)
    since = np.where(right > 0, times[held] - times[news[(right - 1).clip(0)]], np.inf)
    until = np.where(right < len(news), times[news[right.clip(0, len(news) - 1)]] - times[held], np.inf)
    near, both = np.minimum(since, until), np.isfinite(since) & np.isfinite(until)
    flown = speed[held] * near
    before, after = news[(right - 1).clip(0)], news[right.clip(0, len(news) - 1)]
    straight = np.hypot(*(ground[after] - ground[before]).T) >= _STRAIGHT_SHARE * speed[held] * (since + until)
    bend = np.where(straight, 0.5 * _TURN_M_S2 * near**2, np.inf)
    sigma = np.where(both, np.minimum(_ASTRAY_SHARE * flown, bend), flown)
    at = np.stack([np.interp(times[held], times[news], ground[news, k]) for k in range(2)], axis=1)
    first = places[order[0]]
    lat = first[0] + np.degrees(at[:, 1] / MEAN_RADIUS_M)
    parallel = MEAN_RADIUS_M * np.cos(np.median(np.radians([places[i][0] for i in order])))
    lon = (first[1] + np.degrees(at[:, 0] / parallel) + 180.0) % 360.0 - 180.0
    longest = float(np.where(both, since + until, near).max())
    return HeldFixes([order[i] for i in held.tolist()], lat, lon, sigma, longest)


def one_fix(places: Sequence[tuple[float, float]]) -> list[int]:
    """The photos of a flight that tell one place, if nearly all do; places: degrees.

    In coordinates with steps of some metres a vehicle at rest tells one place, too, and all are believed.
    """
    place, count = Counter(places).most_common(1)[0] if places else ((0.0, 0.0), 0)
    if count < max(_ONE_FIX_LEAST, _ONE_FIX_SHARE * len(places)) or 0.0 < _quantum_m(np.array(places)) <= _NEWS_M:
        return []
    return [i for i, told in enumerate(places) if told == place]


def coarse_m(places: Sequence[tuple[float, float]]) -> float:
    """The steps in which a flight's coordinates were written, metres; 0 where they are fine; places: degrees."""
    return _quantum_m(np.array(places)) if len(places) >= _COARSE_LEAST else 0.0


def _quantum_m(degrees: Array) -> float:
    """The steps of coordinates (N, 2) with few decimals of degrees, minutes or seconds, metres; 0 where fine."""
    for steps in _COARSE_STEPS:
        scaled = degrees * steps
        if np.abs(scaled - scaled.round()).max() < 1e-9 * steps:
            return DEGREE_M / steps
    return 0.0


def _mark_repeated(times: Array, ground: Array, speed: Array, news_m: float) -> None:
    """Mark fixes that repeat the one before although the vehicle flew, and those of before a restart.

    The next other fix decides: either the vehicle flew all the time since the first of the equal fixes, or it stood
    until the last one, whichever of the two speeds is nearer to that around it.
    """
    first = np.flatnonzero(np.r_[True, np.any(np.diff(ground, axis=0) != 0.0, axis=1)])
    last = np.r_[first[1:], len(times)] - 1
    if len(first) < 2:
        return
    way = np.hypot(*np.diff(ground[first], axis=0).T)
    flying = _over(way, np.diff(times[first]))
    standing = _over(way, times[first[1:]] - times[last[:-1]])
    around = _around(flying)
    lasted = times[last] - times[first]
    usual_s = min(_USUAL_REPEATS * float(np.median(lasted)), _SLOWEST_S)
    for k in np.flatnonzero(lasted > usual_s).tolist():
        a, b = int(first[k]), int(last[k]) + 1
        if k == len(way):  # nothing follows: it is as old as the vehicle was fast
            before = float(np.median(flying[-_AROUND:]))
            if before * lasted[k] > news_m:
                speed[a + 1 : b] = before
            continue
        usual = float(around[k])
        if way[k] <= news_m or usual <= 0.0:
            continue
        came_too_fast = k == 0 or flying[k - 1] > _FASTER * usual
        if flying[k] > _FASTER * usual and came_too_fast:
            speed[a:b] = usual
        elif abs(np.log(flying[k] / usual)) < abs(np.log(standing[k] / usual)):
            speed[a + 1 : b] = max(usual, float(flying[k]))


def _mark_foretold(times: Array, ground: Array, speed: Array, news_m: float) -> None:
    """Mark fixes that continue the way before them exactly, up to a jump onto the way that was flown."""
    news = np.flatnonzero(speed == 0.0)
    if len(news) <= _FORETOLD_LEAST:
        return
    t, g = times[news], ground[news]
    step, lasted = np.diff(g, axis=0), np.diff(t)
    way = np.hypot(*step.T)
    pace = _over(way, lasted)
    around = _around(pace)
    coarse_s = 1.0 if np.all(times == np.round(times)) else 0.0  # times in whole seconds
    longer = np.divide(lasted[1:], lasted[:-1], out=np.ones(len(t) - 2), where=lasted[:-1] > 0.0)
    off = step[1:] - step[:-1] * longer[:, None]
    ahead = step[1:] / np.maximum(way[1:], 1e-9)[:, None]
    across, along = np.abs(ahead[:, 0] * off[:, 1] - ahead[:, 1] * off[:, 0]), np.abs((ahead * off).sum(axis=1))
    exact_m = _FORETOLD_SHARE * float(np.median(across))
    rounded_m = exact_m + coarse_s * np.minimum(pace[1:], _FASTEST_M_S)
    foretold = (across <= exact_m) & (along <= rounded_m) & (way[1:] > 0.0) & (exact_m > 0.0)
    for k in np.flatnonzero((pace > _FASTER * around) & (way > news_m) & (around > 0.0)).tolist():
        j = k
        while j >= 2 and foretold[j - 2] and t[k] - t[j] < _FORETOLD_LONGEST_S:
            j -= 1
        flown = float(np.hypot(*(g[k + 1] - g[j]))) / max(float(t[k + 1] - t[j]), 1e-9)
        if k - j >= _FORETOLD_LEAST and flown <= _LIKE * around[k]:
            speed[news[j + 1 : k + 1]] = max(float(around[k]), flown)


def _over(way: Array, lasted: Array) -> Array:
    """Speeds (N,), infinite where no time passed."""
    return np.divide(way, lasted, out=np.where(way > 0.0, np.inf, 0.0), where=lasted > 0.0)


def _around(pace: Array) -> Array:
    """The speed around each of N steps: the median of those before or of those after, whichever is larger."""
    some = np.where(np.isfinite(pace), pace, 0.0)
    ends = np.zeros(_AROUND)
    medians = np.median(np.lib.stride_tricks.sliding_window_view(np.r_[ends, some, ends], _AROUND), axis=1)
    return np.asarray(np.maximum(medians[: len(pace)], medians[_AROUND + 1 :][: len(pace)]))


class FixNews:
    """How far a vehicle may have flown since its receiver had news, fix by fix as they come."""

    def __init__(self) -> None:
        self._place: tuple[float, float] | None = None
        self._since_s = 0.0
        self._speeds: deque[float] = deque(maxlen=_AROUND)
        self.held_m = 0.0

    def hear(self, time_s: float, place: tuple[float, float], speed_m_s: float | None) -> float:
        """The sigma that a fix has besides the receiver's, metres: 0 for a new place, else by speed and age.

        speed_m_s: as the vehicle states it, None: as it flew before.
        """
        age_s = time_s - self._since_s
        if place == self._place:
            before = float(np.median(self._speeds)) if self._speeds else 0.0
            self.held_m = max(age_s, 0.0) * (before if speed_m_s is None else speed_m_s)
            return self.held_m
        if self._place is not None and age_s > 0.0:
            self._speeds.append(distance_m(*self._place, *place) / age_s)
        self._place, self._since_s, self.held_m = place, time_s, 0.0
        return 0.0


def without_held_fixes(
    samples: Sequence[Sample], times_s: Sequence[float | None], source: str
) -> tuple[list[Sample], list[Finding]]:
    """One flight's samples whose held fixes lie between measured ones, or have no position; a finding if it matters.

    times_s: of the samples, in one clock. source: name of the file, for the message.
    """
    placed = [i for i, sample in enumerate(samples) if sample.has_position]
    held = held_fixes([times_s[i] for i in placed], [samples[i].place for i in placed])
    sound = list(samples)
    for n, lat, lon, sigma in held.each():
        own = samples[placed[n]]
        if sigma > LOST_SIGMA_M:
            sound[placed[n]] = replace(own, lat_deg=None, lon_deg=None, sigma_m=None)
        else:
            sound[placed[n]] = replace(own, lat_deg=lat, lon_deg=lon, sigma_m=stated_sigma_m(own.sigma_m, sigma))
    return sound, [held.finding(source)] if matters(held) else []


def measured_frames(frames: Sequence[Frame]) -> list[Frame]:
    """One flight's frames, those with held fixes between measured ones, with the sigma of that however large it is."""
    held = held_fixes([f.time_s for f in frames], [(f.fix.lat_deg, f.fix.lon_deg) for f in frames])
    sound = list(frames)
    for n, lat, lon, sigma in held.each():
        fix = frames[n].fix
        stated = stated_sigma_m(fix.position_sigma_m, sigma)
        sound[n] = replace(frames[n], fix=replace(fix, lat_deg=lat, lon_deg=lon, position_sigma_m=stated))
    return sound


def stated_sigma_m(own: float | None, held: float) -> float | None:
    """The sigma of a place between measured fixes: stated if it is larger than that of any receiver."""
    if own is None:
        return held if held > UNSTATED_SIGMA_M else None
    return float(np.hypot(own, held))


def matters(held: HeldFixes) -> bool:
    """Whether held fixes are farther off than a receiver's usual noise."""
    return bool((held.sigma_m > UNSTATED_SIGMA_M).any())

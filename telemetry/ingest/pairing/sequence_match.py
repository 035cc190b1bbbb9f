"""Matches photos with camera events, two recordings of one sequence of exposures, by their times.

A camera and an autopilot record the same exposures, each with its own clock and each missing some. They are matched as
sequences (`sequence_model`) under every clock offset and drift that their correlation leaves possible. The probability
of each pairing is summed over all of these clocks, so that a photo whose times allow several events comes out as
undecided, not as the nearest event.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Indices
from telemetry.ingest.pairing.motion_chains import PictureMotion, chains_of, variants
from telemetry.ingest.pairing.sequence_model import (
    FIRST_JITTER_S,
    MOST_DRIFT,
    ClockGrid,
    SequenceModel,
    clock_grid,
    forward,
    posterior,
)

Clock = tuple[float, float]  # offset in seconds and drift

CERTAIN: Final = 1.0 - 1e-4  # probability from which on a pairing counts as certain
_OTHER_CLOCK_INTERVALS: Final = 10.0  # clocks that differ by more usual intervals are two ways to pair a flight
_SAME_EXPOSURE_S: Final = 0.12
"""Camera events closer than this are one exposure that was recorded twice; at most 0.35 of the usual interval
(CAMERA_TRIGGER and CAMERA_IMAGE_CAPTURED of one exposure are up to 0.1 s apart)."""
_INTERVAL_MARGIN: Final = 0.9  # no two exposures are closer than this share of the shortest recorded interval
_NEGLIGIBLE_LOG_ODDS: Final = 16.0  # clocks of lower odds than exp(-16), 1e-7, against the best are left out
_JITTERS_S: Final = (0.02, 0.03, 0.045, 0.07, 0.1, 0.16)  # the sigmas that are then tried
_MISSING_ODDS: Final = (0.03, 0.06, 0.12, 0.2, 0.35)
"""Odds of a missing photo, and of a missing event, that are tried; not less than 0.03, since a flight without any loss
does not show that there can be none."""
_CLOCK_CANDIDATES: Final = 24  # maxima of the correlation of the two recordings whose clocks are examined
_MOST_WINDOWS: Final = 64  # windows of possible clocks over which the probabilities are summed at most
_WINDOW_DRIFT_S: Final = 0.16  # half width in drift of such a window, as the shift of the first and last exposure
_MOST_BINS: Final = 1 << 19  # bins of the correlation at most: longer recordings get wider bins (8 MB)
_MOST_DRIFTS: Final = 81  # drifts that are correlated at most
_PICTURES_FROM_S: Final = 0.5  # resolution of the camera's times from which pictures decide
_LEAST_AGREEMENT: Final = 0.9  # a pairing by pictures keeps this share of the pairs by times alone
_LEAST_MATCHED: Final = 0.6  # share of photos or events with a partner
_LEAST_PROBABILITY: Final = 0.02  # events that a photo has with less probability are not listed as its alternatives


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceMatch:
    """Probabilities of pairings."""

    events: Indices  # (K,) index of each event, without repetitions
    first: Indices  # (N,) index into `events` of column 0 of a photo's row
    probability: Array  # (N, B) of each photo and event
    offset_s: float  # photo time minus event time in the middle of the events
    drift: float  # rate of the photo's clock minus one
    resolution_s: float  # of the photo's clock
    by_pictures: bool = False  # whether the pictures were asked, too
    other_clock: float = 0.0  # probability that the clocks differ by another offset, some intervals away

    def pairs(self) -> list[tuple[int, int, float]]:
        """The alignment with the most expected matches: photo, event (both increasing) and probability.

        A heaviest increasing subsequence, with a Fenwick tree of prefix maxima over the events.
        """
        tree: list[tuple[float, int]] = [(0.0, -1)] * (len(self.events) + 2)
        nodes: list[tuple[int, int, float, int]] = []  # photo, event, probability, node before
        for i, row in enumerate(self.probability):
            reached = []
            for column in np.flatnonzero(row > _LEAST_PROBABILITY).tolist():
                event = int(self.first[i]) + column
                value, before = _prefix_maximum(tree, event)
                nodes.append((i, event, float(row[column]), before))
                reached.append((event, value + float(row[column]), len(nodes) - 1))
            for event, value, node in reached:
                _raise_to(tree, event + 1, (value, node))
        pairs = []
        node = _prefix_maximum(tree, len(self.events))[1]
        while node >= 0:
            i, event, probability, node = nodes[node]
            pairs.append((i, int(self.events[event]), probability))
        return pairs[::-1]

    def may_have_none(self, photo: int) -> bool:
        """Whether another clock, under which a photo has no event, is possible: then its event is no likely place."""
        possible = self.other_clock > _LEAST_PROBABILITY
        return bool(possible and self.probability[photo].sum() < 1.0 - _LEAST_PROBABILITY)

    def alternatives(self, photo: int) -> list[int]:
        """Events that a photo may belong to."""
        columns = np.flatnonzero(self.probability[photo] > _LEAST_PROBABILITY)
        return [int(self.events[self.first[photo] + column]) for column in columns]


def _prefix_maximum(tree: list[tuple[float, int]], end: int) -> tuple[float, int]:
    best = (0.0, -1)
    while end > 0:
        best = max(best, tree[end])
        end -= end & -end
    return best


def _raise_to(tree: list[tuple[float, int]], at: int, entry: tuple[float, int]) -> None:
    while at < len(tree):
        tree[at] = max(tree[at], entry)
        at += at & -at


def match_sequences(photos: Array, events: Array, motion: PictureMotion | None = None) -> SequenceMatch | None:
    """Match two increasing sequences of times; None if they cannot be matched.

    Args:
        photos: (N,) by the camera's clock, whole seconds or finer, equal ones in order of exposure.
        events: (M,) by the vehicle's clock; one exposure recorded twice within 0.12 s counts once.
        motion: what the pictures show, asked for where the times do not decide.
    """
    if len(photos) < 2 or len(events) < 2:
        return None
    single = _single_events(events)
    if len(single) < 2:
        return None
    middle = 0.5 * float(events[single[0]] + events[single[-1]])
    e = events[single] - middle
    resolution = _resolution(photos)
    p = photos - photos[0] + 0.5 * resolution
    usual = float(np.median(np.diff(e)))
    least = _least_interval(p, e, resolution)
    model = SequenceModel(p=p, e=e, resolution_s=resolution, interval_s=usual, least_s=least)
    model, windows = _plausible(model)
    if not windows:
        return None
    result = _alignment(model, windows, single)
    if motion is not None and resolution >= _PICTURES_FROM_S and (~_decided(result)).any():
        chained = _chained(model, result, motion)
        again = None if chained is None else _alignment(chained, windows, single)
        result = again if again is not None and _decides_more(again, result) else result
    return replace(result, offset_s=result.offset_s + float(photos[0]) - middle)


def _alignment(model: SequenceModel, windows: list[Clock], single: Indices) -> SequenceMatch:
    """The match, with probabilities of existing events only; its offset is between the model's own origins."""
    first, probability, offset, drift, other_clock = _probabilities(model, windows)
    inside = np.clip(first, 0, len(single))
    shifted = np.zeros_like(probability)
    for i, (lo, at) in enumerate(zip(first.tolist(), inside.tolist(), strict=True)):
        keep = max(0, min(probability.shape[1] - (at - lo), len(single) - at))
        shifted[i, :keep] = probability[i, at - lo : at - lo + keep]
    return SequenceMatch(
        events=single, first=inside, probability=shifted, offset_s=offset, drift=drift, resolution_s=model.resolution_s,
        by_pictures=model.chains is not None, other_clock=other_clock,
    )  # fmt: skip


def _decided(match: SequenceMatch) -> Flags:
    """(N,) whether a photo's event is certain, or that it has none."""
    likeliest = match.probability.max(axis=1, initial=0.0)
    return np.asarray((likeliest >= CERTAIN) | (match.probability.sum(axis=1) <= 1.0 - CERTAIN))


def _decides_more(now: SequenceMatch, before: SequenceMatch) -> bool:
    """Whether more photos are decided now and hardly fewer have an event; else log and pictures disagree."""
    more = _decided(now).sum() > _decided(before).sum()
    least = _LEAST_MATCHED * min(len(now.probability), len(now.events))
    return bool(more and now.probability.sum() > max(_LEAST_AGREEMENT * before.probability.sum(), least))


def _chained(model: SequenceModel, match: SequenceMatch, motion: PictureMotion) -> SequenceModel | None:
    """The model with what the pictures of the undecided photos show; None where they show nothing."""
    offset, drift = match.offset_s, match.drift
    unsure = ~_decided(match)
    steps = np.full(len(unsure) - 1, np.nan)
    wanted = unsure[1:] | unsure[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wanted, [False]]).astype(np.int8)))
    for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        steps[start:end] = motion.shifts_px(range(start, end + 1))
    path = motion.path_m[match.events]
    chains = chains_of(
        steps, model.p, model.e, path_m=path, resolution_s=model.resolution_s, offset=offset, drift=drift
    )
    if chains is None:
        return None
    clock = ClockGrid(np.array([offset]), np.array([drift]), (offset, drift), model.resolution_s)
    # With chains far fewer photos and events have to be missing to explain the times than without.
    scored = [replace(model, chains=variant, no_event=0.03, no_photo=0.03) for variant in variants(chains)]
    best = max(scored, key=lambda trial: float(forward(trial, clock).evidence[0]))
    return _with_odds(best, clock)


def _single_events(events: Array) -> Indices:
    """Indices of events without repetitions."""
    steps = np.diff(events)
    usual = float(np.median(steps[steps > 0.01])) if (steps > 0.01).any() else 1.0
    return np.flatnonzero(np.concatenate([[True], steps > min(_SAME_EXPOSURE_S, 0.35 * usual)]))


def _least_interval(photos: Array, events: Array, resolution: float) -> float:
    """Time between exposures in seconds that hardly any two of them go below."""
    least = float(np.quantile(np.diff(events), 0.02))
    if resolution < 0.05:
        return _INTERVAL_MARGIN * min(least, float(np.quantile(np.diff(photos), 0.02)))
    together = int(np.unique(np.floor(photos / resolution), return_counts=True)[1].max())
    return _INTERVAL_MARGIN * (min(least, resolution / (together - 1)) if together > 1 else least)


def _resolution(times: Array) -> float:
    """Resolution of a clock in seconds: the coarsest step of which all times are multiples; 0 if finer than 0.05 s."""
    for step in (1.0, 0.5, 0.1, 0.05):
        if np.abs(times / step - np.round(times / step)).max() < 1e-3:
            return step
    return 0.0


def _correlation_peaks(model: SequenceModel) -> Iterator[Clock]:
    """Offsets and drifts under which most photos fall on events, the best first."""
    p, e = model.p, model.e
    span = float(np.ptp(p) + np.ptp(e)) * (1.0 + MOST_DRIFT) + 4.0
    bin_s = max(0.25 if model.resolution_s >= 0.5 else 0.1, span / _MOST_BINS)
    size = 1 << int(np.ceil(np.log2(span / bin_s + 16)))
    half = max(0.5 * float(np.ptp(e)), 1e-3)
    count = min(int(np.ceil(MOST_DRIFT * half / bin_s)), _MOST_DRIFTS // 2)
    drifts = np.linspace(-MOST_DRIFT, MOST_DRIFT, 2 * count + 1) if count else np.zeros(1)
    photos = np.fft.rfft(_train(p - p[0], bin_s, size, model.resolution_s))
    best, drift_at = np.full(size, -np.inf), np.zeros(size)
    for drift in drifts:
        own = (1.0 + drift) * (e - e[0])
        together = np.fft.irfft(np.conj(np.fft.rfft(_train(own, bin_s, size, 0.0))) * photos, size)
        # The lag is between the first event and the first photo; offsets count from the middle of the events.
        better = together > best
        best[better], drift_at[better] = together[better], drift
    apart = max(1, round(_reach_s(model) / bin_s))
    for _ in range(_CLOCK_CANDIDATES):
        lag = int(np.argmax(best))
        if not np.isfinite(best[lag]) or best[lag] < 0.25:
            return
        # Around the end are lags of events before the first photo; the photos may last far longer than the events.
        signed = lag if lag * bin_s <= float(np.ptp(p)) + 2.0 else lag - size
        drift = float(drift_at[lag])
        yield float(p[0]) + signed * bin_s - (1.0 + drift) * float(e[0]), drift
        best[np.arange(lag - apart, lag + apart + 1) % size] = -np.inf


def _reach_s(model: SequenceModel) -> float:
    """How far around a peak of the correlation clocks are tried."""
    return 0.8 if model.resolution_s >= 0.5 else 0.25


def _train(times: Array, bin_s: float, size: int, width_s: float) -> Array:
    """(size,) one unit for each time, spread over the clock's resolution and the two nearest bins."""
    spread = np.arange(-0.5 * width_s, 0.5 * width_s + 1e-9, bin_s) if width_s > bin_s else np.zeros(1)
    places = ((times[:, None] + spread[None, :]) / bin_s).ravel()
    low = np.floor(places).astype(np.int64)
    share = places - low
    train = np.zeros(size)
    np.add.at(train, low % size, (1.0 - share) / len(spread))
    np.add.at(train, (low + 1) % size, share / len(spread))
    return train


def _plausible(model: SequenceModel) -> tuple[SequenceModel, list[Clock]]:
    """The model's parameters for the best clock, and centres of windows that hold all clocks still possible."""
    bin_s = 0.25 if model.resolution_s >= 0.5 else 0.1
    grids = [clock_grid(model, *peak, _reach_s(model), bin_s) for peak in _correlation_peaks(model)]
    if not grids:
        return model, []
    evidence = np.concatenate([forward(model, grid).evidence for grid in grids])
    clocks = np.stack([np.concatenate([grid.offset for grid in grids]), np.concatenate([grid.drift for grid in grids])])
    best = int(np.argmax(evidence))
    if not np.isfinite(evidence[best]):
        return model, []
    # The first parameters are guesses: exclude only what they make impossible.
    possible = evidence > evidence[best] - 3.0 * _NEGLIGIBLE_LOG_ODDS
    order = np.argsort(-evidence, kind="stable")
    clocks = clocks[:, order[possible[order]]]
    model = _fitted(model, *clocks[:, 0].tolist()).regular()
    windows: list[Clock] = []
    while clocks.shape[1] and len(windows) < _MOST_WINDOWS:
        windows.append((float(clocks[0, 0]), float(clocks[1, 0])))
        clocks = clocks[:, ~_inside(model, windows[-1], clocks[0], clocks[1], share=0.75)]
    return model, windows


def _inside(model: SequenceModel, centre: Clock, offset: Array, drift: Array, *, share: float = 1.0) -> Flags:
    """Which clocks lie in a share of the window around one."""
    half = max(0.5 * float(np.ptp(model.e)), 1e-3)
    reach = share * (2.0 * FIRST_JITTER_S + 0.3 * _reach_s(model))
    apart = half * np.abs(drift - centre[1])
    return np.asarray((np.abs(offset - centre[0]) <= reach) & (apart <= share * _WINDOW_DRIFT_S))


def _fitted(model: SequenceModel, offset: float, drift: float) -> SequenceModel:
    """Jitter and shares of missing exposures with the most evidence."""
    trials = []
    for jitter in _JITTERS_S:
        trial = replace(model, jitter_s=jitter)
        grid = clock_grid(trial, offset, drift, 2.0 * FIRST_JITTER_S, 2.0 * FIRST_JITTER_S)
        trials += [(replace(trial, no_event=odds, no_photo=odds), grid) for odds in _MISSING_ODDS[::2]]
    return _with_odds(*max(trials, key=lambda trial: _normalised(*trial)))


def _with_odds(model: SequenceModel, grid: ClockGrid) -> SequenceModel:
    """The odds of missing events and missing photos with the most evidence, one after the other."""

    def best(trials: Iterable[SequenceModel]) -> SequenceModel:
        return max(trials, key=lambda trial: _normalised(trial, grid))

    model = best(replace(model, no_event=odds) for odds in _MISSING_ODDS)
    model = best(replace(model, no_photo=odds) for odds in _MISSING_ODDS)
    return best(replace(model, no_event=odds) for odds in _MISSING_ODDS)


def _normalised(model: SequenceModel, grid: ClockGrid) -> float:
    """Logarithm of the evidence for the best clock, comparable between different odds of missing exposures."""
    weights = len(model.p) * np.log1p(model.no_event) + len(model.e) * np.log1p(model.no_photo)
    return float(forward(model, grid).evidence.max() - weights)


def _probabilities(model: SequenceModel, windows: list[Clock]) -> tuple[Indices, Array, float, float, float]:
    """(N,) first event and (N, B) probabilities of each photo's events; the most likely offset and drift.

    The last value is the probability of an offset that is some intervals away from that one.
    """
    scored = []
    for number, centre in enumerate(windows):
        grid = clock_grid(model, *centre, 2.0 * FIRST_JITTER_S + 0.3 * _reach_s(model), _WINDOW_DRIFT_S)
        fresh = np.ones(len(grid.offset), dtype=bool)
        for other in windows[:number]:
            fresh &= ~_inside(model, other, grid.offset, grid.drift)
        if fresh.any():
            grid = replace(grid, offset=grid.offset[fresh], drift=grid.drift[fresh])
            scored.append((grid, forward(model, grid).evidence))
    most = max(float(evidence.max()) for _, evidence in scored)
    total = np.logaddexp.reduce(np.concatenate([evidence for _, evidence in scored]))
    parts: list[tuple[Indices, Array]] = []
    for grid, evidence in scored:
        chosen = np.flatnonzero(evidence > most - _NEGLIGIBLE_LOG_ODDS)
        if len(chosen):
            some = replace(grid, offset=grid.offset[chosen], drift=grid.drift[chosen])
            parts.append((some.band(model)[0], posterior(model, some, float(total))))
    best, values = max(scored, key=lambda row: float(row[1].max()))
    at = int(np.argmax(values))
    far = _OTHER_CLOCK_INTERVALS * float(np.median(np.diff(model.e)))
    away = [values[np.abs(grid.offset - best.offset[at]) > far] for grid, values in scored]
    other_clock = float(np.exp(np.logaddexp.reduce(np.concatenate([*away, [-np.inf]])) - total))
    first = np.min([lo for lo, _ in parts], axis=0)
    width = max(int((lo + part.shape[1] - first).max()) for lo, part in parts)
    joined = np.zeros((len(model.p), width))
    for lo, part in parts:
        for i, shift in enumerate((lo - first).tolist()):
            joined[i, shift : shift + part.shape[1]] += part[i]
    return first, joined, float(best.offset[at]), float(best.drift[at]), other_clock

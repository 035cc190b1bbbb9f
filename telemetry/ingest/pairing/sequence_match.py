"""Two recordings of one sequence of exposures, matched by their times.

A camera and an autopilot record the same exposures, each with its own clock and each missing some. Both are matched as
sequences (a pair hidden Markov model with the states match, photo without event, event without photo; Durbin et al.,
"Biological Sequence Analysis", chapter 4) under the clock offsets and drifts that their correlation proposes. The
forward-backward algorithm, summed over all clocks, gives the probability of every pairing: a pairing that the times
leave
open comes out as undecided, not as the nearest event.

Exposures are modelled as a Poisson process with the usual interval, so a match of residual u weighs f(u) times the
interval,
where f is a uniform density as wide as the camera's clock resolution (one second for EXIF without sub-seconds)
convolved with a Gaussian of the trigger's jitter. Exposures that are missing at an end weigh less than those missing in
between: logs begin before the first photo.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from orthoswarm.model.robust import mad_sigma
from telemetry.ingest.pairing.alignment import SequenceMatch
from telemetry.ingest.pairing.motion_chains import Chains, PictureMotion, chains_of, variants

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MOST_DRIFT = 1.2e-3
"""Seconds a second: quartz clocks of cameras stay below 1e-4, a tenfold margin for poor ones."""
_SAME_EXPOSURE_S = 0.12
_MISSING_AT_END = 0.5
_NEGLIGIBLE = 16.0
"""Natural logarithm of the odds beyond which a hypothesis is left out."""
_CLOCK_DOUBT = 1e-3
"""Probability of other clocks (by more than half an interval) above which each photo's is not believed."""
_COARSE_S = 0.5
"""Resolution of a clock from which on pictures tell more than times do."""
_LEAST_AGREEMENT = 0.9
_LEAST_MATCHED = 0.6
"""Share of photos or events with a partner; a clock that leaves more alone is not the right one."""
_CANDIDATES = 24
_FIRST_JITTER_S = 0.08
_JITTERS_S = (0.02, 0.04, 0.08, 0.16)
_MISSING = (0.01, 0.03, 0.1, 0.35)
_MOST_BINS = 1 << 19
_MOST_DRIFTS = 81


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
    problem = _Problem(p=p, e=e, resolution_s=resolution, interval_s=float(np.median(np.diff(e))))
    problem, candidates = _plausible(problem)
    if not candidates:
        return None
    result = _alignment(problem, candidates, single)
    if motion is not None and resolution >= _COARSE_S and (~_decided(result)).any():
        chained = _chained(problem, result, motion)
        again = None if chained is None else _alignment(chained, candidates, single)
        result = again if again is not None and _decides_more(again, result) else result
    return replace(result, offset_s=result.offset_s + float(photos[0]) - middle)


def _alignment(problem: "_Problem", candidates: list[tuple[float, float]], single: Indices) -> SequenceMatch:
    """Probabilities for events that there are; the offset is that of the problem's own origins."""
    first, probability, offset, drift, clock_doubt = _probabilities(problem, candidates)
    inside = np.clip(first, 0, len(single))
    shifted = np.zeros_like(probability)
    for i, (lo, at) in enumerate(zip(first.tolist(), inside.tolist(), strict=True)):
        keep = max(0, min(probability.shape[1] - (at - lo), len(single) - at))
        shifted[i, :keep] = probability[i, at - lo : at - lo + keep]
    if clock_doubt < _CLOCK_DOUBT:
        shifted = _without_coincidences(problem, inside, shifted, offset, drift)
    asked = problem.chains is not None
    return SequenceMatch(
        events=single,
        first=inside,
        probability=shifted,
        offset_s=offset,
        drift=drift,
        resolution_s=problem.resolution_s,
        jitter_s=problem.jitter_s,
        by_pictures=asked,
    )


def _decided(match: SequenceMatch) -> NDArray[np.bool_]:
    """(N,) whether a photo's event is certain, or that it has none."""
    likeliest = match.probability.max(axis=1, initial=0.0)
    return np.asarray((likeliest >= match.certain) | (match.probability.sum(axis=1) <= 1.0 - match.certain))


def _decides_more(now: SequenceMatch, before: SequenceMatch) -> bool:
    """Whether more photos are decided than before, and as many have an event: else log and pictures disagree."""
    more = _decided(now).sum() > _decided(before).sum()
    least = _LEAST_MATCHED * min(len(now.probability), len(now.events))
    return bool(more and now.probability.sum() > max(_LEAST_AGREEMENT * before.probability.sum(), least))


def _chained(problem: "_Problem", match: SequenceMatch, motion: PictureMotion) -> "_Problem | None":
    """The problem with what the pictures of the undecided photos show; None where they show nothing."""
    offset, drift = match.offset_s, match.drift
    unsure = ~_decided(match)
    steps = np.full(len(unsure) - 1, np.nan)
    wanted = unsure[1:] | unsure[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wanted, [False]]).astype(np.int8)))
    for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        steps[start:end] = motion.shifts_px(range(start, end + 1))
    path = motion.path_m[match.events]
    chains = chains_of(
        steps, problem.p, problem.e, path_m=path, resolution_s=problem.resolution_s, offset=offset, drift=drift
    )
    if chains is None:
        return None
    clock = _Grid(np.array([offset]), np.array([drift]), (offset, drift), problem.resolution_s)
    # With chains far fewer photos and events have to be missing to explain the times than without.
    scored = [replace(problem, chains=variant, missing=0.03) for variant in variants(chains)]
    best = max(scored, key=lambda trial: float(_forward(trial, clock).evidence[0]))
    scored = [replace(best, missing=missing) for missing in _MISSING]
    return max(scored, key=lambda trial: float(_forward(trial, clock).evidence[0]) - _normalisation(trial))


def _without_coincidences(
    problem: "_Problem", first: Indices, probability: Array, offset: float, drift: float
) -> Array:
    """Probabilities under the condition that exposures are never closer than the camera's least interval.

    The Poisson process allows a photo without event and an event without photo at the same time. Where every exposure
    that
    the photo's time allows lies closer to its likeliest event than the least interval, the two are the same exposure,
    and only events compete.
    """
    least = float(np.quantile(np.diff(problem.e), 0.02))
    rows = np.arange(len(problem.p))
    best = np.argmax(probability, axis=1)
    expected = offset + (1.0 + drift) * problem.e[np.clip(first + best, 0, len(problem.e) - 1)]
    # With pictures legs are placed one by one, under a clock of whole seconds that is known to half a second only.
    clock_s = 0.5 * problem.resolution_s if problem.chains is not None else 0.0
    farthest = np.abs(problem.p - expected) + 0.6 * problem.resolution_s + 3.0 * problem.jitter_s + clock_s
    total = probability.sum(axis=1)
    alone = (farthest < least) & (probability[rows, best] > 1e-4)
    return np.where(alone[:, None], probability / np.maximum(total, 1e-300)[:, None], probability)


def _single_events(events: Array) -> Indices:
    """Indices of events without repetitions."""
    steps = np.diff(events)
    usual = float(np.median(steps[steps > 0.01])) if (steps > 0.01).any() else 1.0
    return np.flatnonzero(np.concatenate([[True], steps > min(_SAME_EXPOSURE_S, 0.35 * usual)]))


def _resolution(times: Array) -> float:
    """Resolution of a clock in seconds: the coarsest step of which all times are multiples; 0 if finer than 0.05 s."""
    for step in (1.0, 0.5, 0.1, 0.05):
        if np.abs(times / step - np.round(times / step)).max() < 1e-3:
            return step
    return 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Problem:
    """Times of photos and events, each relative to its own origin, and the model's parameters.

    Attributes:
        p: (N,) middle of each photo's interval. e: (M,) from the middle of the events.
        resolution_s: width of a photo's interval. interval_s: time between exposures that matches are weighed with.
        jitter_s: one sigma. missing: odds of one exposure missing from one of the recordings.
        chains: what the pictures show, None where they were not asked.
    """

    p: Array
    e: Array
    resolution_s: float
    interval_s: float
    jitter_s: float = _FIRST_JITTER_S
    missing: float = 0.1
    chains: Chains | None = None

    @property
    def hypotheses(self) -> int:
        """Hypotheses C about each chain of photos."""
        return 1 if self.chains is None else len(self.chains.scales)

    def weights(self, i: int, first: int, width: int, offset: Array, drift: Array) -> Array:
        """(H C, width) weight of photo i being the event `first` and those after it, by clock and hypothesis."""
        at = np.arange(first, first + width)
        inside = (at >= 0) & (at < len(self.e))
        e = self.e[np.clip(at, 0, len(self.e) - 1)]
        u = self.p[i] - offset[:, None] - (1.0 + drift[:, None]) * e
        q, sigma = self.resolution_s, self.jitter_s
        if q >= 0.05:
            density = (ndtr((u + 0.5 * q) / sigma) - ndtr((u - 0.5 * q) / sigma)) / q
        else:
            density = np.exp(-0.5 * (u / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
        weights = np.asarray(np.where(inside, self.interval_s * density, 0.0))
        if self.chains is None:
            return weights
        factors = self.chains.factors(i, first, width, offset, drift)
        return np.asarray((weights[:, None, :] * factors).reshape(-1, width))

    def alone(self, i: int, offset: Array, drift: Array) -> Array:
        """(H C, 1) weight of photo i having no event."""
        if self.chains is None:
            return np.full((len(offset), 1), self.missing)
        return self.missing * self.chains.alone(i, offset, drift).reshape(-1, 1)

    def regular(self) -> "_Problem":
        """The same problem for exposures at intervals as even as these.

        At even intervals a clock that is off by whole intervals aligns photos with events, too, so that a coincidence
        counts only by the variation of the intervals, not by a full interval.
        """
        steps = np.diff(self.e)
        spread = mad_sigma(steps - np.median(steps))
        widest = max(self.resolution_s, float(np.sqrt(2.0 * np.pi)) * max(self.jitter_s, spread))
        return replace(self, interval_s=min(self.interval_s, widest))


@dataclass(frozen=True, slots=True)
class _Grid:
    """Clocks around a given one: offsets (H,) in seconds and drifts (H,); half widths bound the band of events."""

    offset: Array
    drift: Array
    centre: tuple[float, float]
    reach_s: float

    def band(self, problem: _Problem) -> tuple[Indices, int]:
        """First event of each photo's band, and the width of all bands."""
        expected = self.centre[0] + (1.0 + self.centre[1]) * problem.e
        reach = self.reach_s + 0.5 * problem.resolution_s + 4.5 * problem.jitter_s
        first = np.searchsorted(expected, problem.p - reach)
        last = np.searchsorted(expected, problem.p + reach)
        return first, max(1, int((last - first).max()))


def _grid(problem: _Problem, offset: float, drift: float, reach_s: float, drift_reach_s: float) -> _Grid:
    """A grid as fine as the jitter: offsets within reach_s, drifts that move the ends by up to drift_reach_s."""
    step = 0.8 * max(problem.jitter_s, 0.04 * problem.resolution_s)
    half = max(0.5 * float(np.ptp(problem.e)), 1e-3)
    offsets = offset + step * np.arange(-np.ceil(reach_s / step), np.ceil(reach_s / step) + 1)
    count = np.ceil(drift_reach_s / (2.0 * step))
    drifts = drift + 2.0 * step / half * np.arange(-count, count + 1)
    drifts = np.unique(np.clip(drifts, -MOST_DRIFT, MOST_DRIFT))
    both = np.meshgrid(offsets, drifts, indexing="ij")
    return _Grid(both[0].ravel(), both[1].ravel(), (offset, drift), reach_s + drift_reach_s + 2.0 * step)


def _correlation_peaks(problem: _Problem) -> Iterator[tuple[float, float]]:
    """Offsets and drifts under which most photos fall on events, the best first."""
    p, e = problem.p, problem.e
    span = float(np.ptp(p) + np.ptp(e)) * (1.0 + MOST_DRIFT) + 4.0
    bin_s = max(0.25 if problem.resolution_s >= 0.5 else 0.1, span / _MOST_BINS)
    size = 1 << int(np.ceil(np.log2(span / bin_s + 16)))
    half = max(0.5 * float(np.ptp(e)), 1e-3)
    count = min(int(np.ceil(MOST_DRIFT * half / bin_s)), _MOST_DRIFTS // 2)
    drifts = np.linspace(-MOST_DRIFT, MOST_DRIFT, 2 * count + 1) if count else np.zeros(1)
    photos = np.fft.rfft(_train(p - p[0], bin_s, size, problem.resolution_s))
    best, drift_at = np.full(size, -np.inf), np.zeros(size)
    for drift in drifts:
        own = (1.0 + drift) * (e - e[0])
        together = np.fft.irfft(np.conj(np.fft.rfft(_train(own, bin_s, size, 0.0))) * photos, size)
        # The lag is between the first event and the first photo; offsets count from the middle of the events.
        better = together > best
        best[better], drift_at[better] = together[better], drift
    apart = max(1, round(_reach_s(problem) / bin_s))
    for _ in range(_CANDIDATES):
        lag = int(np.argmax(best))
        if not np.isfinite(best[lag]) or best[lag] < 0.25:
            return
        signed = lag if lag < size // 2 else lag - size
        drift = float(drift_at[lag])
        yield float(p[0]) + signed * bin_s - (1.0 + drift) * float(e[0]), drift
        best[np.arange(lag - apart, lag + apart + 1) % size] = -np.inf


def _reach_s(problem: _Problem) -> float:
    """How far around a peak of the correlation clocks are tried."""
    return 0.8 if problem.resolution_s >= 0.5 else 0.25


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


def _plausible(problem: _Problem) -> tuple[_Problem, list[tuple[float, float]]]:
    """The model's parameters for the best clock, and the clocks that are still possible."""
    tried: list[tuple[float, float, float]] = []
    bin_s = 0.25 if problem.resolution_s >= 0.5 else 0.1
    for offset, drift in _correlation_peaks(problem):
        grid = _grid(problem, offset, drift, _reach_s(problem), bin_s)
        evidence = _forward(problem, grid).evidence
        at = int(np.argmax(evidence))
        tried.append((float(evidence[at]), float(grid.offset[at]), float(grid.drift[at])))
    tried.sort(reverse=True)
    if not tried or not np.isfinite(tried[0][0]):
        return problem, []
    problem = _fitted(problem, tried[0][1], tried[0][2]).regular()
    # The first parameters are guesses: exclude only what they make impossible.
    return problem, [(o, d) for value, o, d in tried if value > tried[0][0] - 3.0 * _NEGLIGIBLE]


def _fitted(problem: _Problem, offset: float, drift: float) -> _Problem:
    """Jitter and share of missing exposures with the most evidence."""
    best: tuple[float, _Problem] | None = None
    for jitter in _JITTERS_S:
        trial = replace(problem, jitter_s=jitter)
        for missing in _MISSING:
            trial = replace(trial, missing=missing)
            grid = _grid(trial, offset, drift, 2.0 * _FIRST_JITTER_S, 2.0 * _FIRST_JITTER_S)
            evidence = float(_forward(trial, grid).evidence.max())
            evidence -= _normalisation(trial)
            if best is None or evidence > best[0]:
                best = evidence, trial
    assert best is not None
    return best[1]


def _normalisation(problem: _Problem) -> float:
    """Normalisation of the model's weights, to compare evidence for different shares of missing exposures."""
    return (len(problem.p) + len(problem.e)) * float(np.log1p(problem.missing))


_Found = tuple[Indices, Array, float, float, float]


@dataclass(slots=True)
class _Forward:
    """Sums over all alignments that end with a match.

    Attributes:
        evidence: (H,) logarithm of the sum over all alignments.
        rows: (N, H C, B) each divided by the exponential of scales (N, H C); empty unless asked for.
    """

    evidence: Array
    rows: Array
    scales: Array


def _forward(problem: _Problem, grid: _Grid, *, backward: bool = False, keep: bool = False) -> _Forward:
    """The forward algorithm over the photos, or from the last one back.

    With m the weight of a match, s that of a missing exposure and t that of one missing at an end,

        F[i, j] = m[i, j] (t^(i + j) + G[i - 1, j - 1]),    G[i, j] = sum over i' <= i, j' <= j of F s^(i - i' + j - j')
    """
    first, width = grid.band(problem)
    count, total, clocks = len(problem.p), len(problem.e), len(grid.offset) * problem.hypotheses
    s, log_t = problem.missing, float(np.log(_MISSING_AT_END))
    columns = np.arange(width + 1)
    decay = np.tril(s ** np.maximum(columns[1:, None] - columns[None, 1:], 0).astype(np.float64)).T
    sums, scale = np.zeros((clocks, width + 1)), np.zeros(clocks)
    evidence = np.full(clocks, -np.inf)
    rows = np.zeros((count, clocks, width)) if keep else np.zeros((0, 0, 0))
    scales = np.zeros((count, clocks)) if keep else np.zeros((0, 0))
    before: int | None = None
    for step in range(count):
        i = count - 1 - step if backward else step
        weight = problem.weights(i, int(first[i]), width, grid.offset, grid.drift)
        lo = int(first[i])
        chains = problem.chains
        if chains is not None and step and (chains.ends(i) if backward else chains.starts(i)):
            sums, scale = _over_hypotheses(sums, scale, problem.hypotheses)
        if backward:
            weight, lo = weight[:, ::-1], total - lo - width
        if before is not None and lo != before:
            at = columns + (lo - before)
            sums = sums[:, np.minimum(at, width)] * s ** np.maximum(at - width, 0)
        before = lo
        leads = np.exp(np.clip(log_t * (step + np.maximum(lo + columns[:-1], 0)) - scale[:, None], -700.0, 700.0))
        found = weight * (leads + sums[:, :-1])
        sums = problem.alone(i, grid.offset, grid.drift) * sums
        sums[:, 1:] += found @ decay
        after = log_t * (count - 1 - step + np.maximum(total - 1 - lo - columns[:-1], 0))
        top = after.max()
        with np.errstate(divide="ignore"):
            evidence = np.logaddexp(evidence, np.log(found @ np.exp(after - top)) + top + scale)
        if keep:
            rows[i], scales[i] = (found[:, ::-1] if backward else found), scale
        largest = np.maximum(sums.max(axis=1), leads[:, 0])
        sums /= largest[:, None]
        scale += np.log(largest)
    evidence = np.logaddexp.reduce(evidence.reshape(-1, problem.hypotheses), axis=1) - np.log(problem.hypotheses)
    return _Forward(evidence, rows, scales)


def _over_hypotheses(sums: Array, scale: Array, count: int) -> tuple[Array, Array]:
    """Sums and their scales where a chain of photos ends: the mean over its hypotheses stands for all of the next."""
    top = scale.reshape(-1, count).max(axis=1, keepdims=True)
    shares = np.exp(scale.reshape(-1, count) - top) / count
    mean = np.einsum("hc,hcb->hb", shares, sums.reshape(len(top), count, -1))
    return np.repeat(mean, count, axis=0), np.repeat(top.ravel(), count)


def _probabilities(problem: _Problem, candidates: list[tuple[float, float]]) -> _Found:
    """First event and probabilities of each photo's band; the most likely offset and drift, and their doubt."""
    scored = []
    for offset, drift in candidates:
        grid = _grid(problem, offset, drift, 2.0 * _FIRST_JITTER_S + 0.3 * _reach_s(problem), 0.16)
        scored.append((grid, _forward(problem, grid).evidence))
    most = max(float(evidence.max()) for _, evidence in scored)
    total = np.logaddexp.reduce(np.concatenate([evidence for _, evidence in scored]))
    parts: list[tuple[Indices, Array]] = []
    for grid, evidence in scored:
        chosen = np.flatnonzero(evidence > most - _NEGLIGIBLE)
        if len(chosen):
            some = replace(grid, offset=grid.offset[chosen], drift=grid.drift[chosen])
            parts.append((some.band(problem)[0], _posterior(problem, some, float(total))))
    best, values = max(scored, key=lambda row: float(row[1].max()))
    at = int(np.argmax(values))
    first = np.min([lo for lo, _ in parts], axis=0)
    width = max(int((lo + part.shape[1] - first).max()) for lo, part in parts)
    joined = np.zeros((len(problem.p), width))
    for lo, part in parts:
        for i, shift in enumerate((lo - first).tolist()):
            joined[i, shift : shift + part.shape[1]] += part[i]
    offset, drift, doubt = float(best.offset[at]), float(best.drift[at]), 0.0
    half, usual = 0.5 * float(np.ptp(problem.e)), float(np.median(np.diff(problem.e)))
    for grid, evidence in scored:
        moved = np.abs(grid.offset - offset) + half * np.abs(grid.drift - drift)
        doubt += float(np.exp(evidence - total)[moved > 0.6 * usual].sum())
    return first, joined, offset, drift, doubt


def _posterior(problem: _Problem, grid: _Grid, total: float) -> Array:
    """(N, B) probability of each photo and event, summed over the clocks of a grid."""
    first, width = grid.band(problem)
    result = np.zeros((len(problem.p), width))
    most = max(1, 4_000_000 // max(1, len(problem.p) * width * problem.hypotheses))
    for start in range(0, len(grid.offset), most):
        part = replace(grid, offset=grid.offset[start : start + most], drift=grid.drift[start : start + most])
        ahead, back = _forward(problem, part, keep=True), _forward(problem, part, backward=True, keep=True)
        for i in range(len(problem.p)):
            weight = problem.weights(i, int(first[i]), width, part.offset, part.drift)
            with np.errstate(divide="ignore", invalid="ignore"):
                both = np.log(ahead.rows[i]) + np.log(back.rows[i]) - np.log(weight)
                both += (ahead.scales[i] + back.scales[i] - total - np.log(problem.hypotheses))[:, None]
                result[i] += np.where(weight > 0.0, np.exp(np.minimum(both, 0.0)), 0.0).sum(axis=0)
    return result

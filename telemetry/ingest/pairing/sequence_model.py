"""A pair hidden Markov model of two recordings of one sequence of exposures.

States: a match, a photo without event, an event without photo (Durbin et al., "Biological Sequence Analysis", chapter
4). Exposures are modelled as a Poisson process with the usual interval, so that a match of residual u weighs f(u) times
the interval, where f is a uniform density as wide as the camera clock's resolution (one second for EXIF without
sub-seconds) convolved with a Gaussian of the trigger's jitter. No two exposures are closer than the camera's least
interval: a photo can be without event only where its time leaves room between the events. Exposures that are missing at
an end weigh less than those missing in between: logs begin before the first photo.
"""

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from scipy.special import ndtr

from orthoswarm.model.arrays import Array, Indices
from orthoswarm.model.robust import mad_sigma
from telemetry.ingest.pairing.motion_chains import Chains

MOST_DRIFT: Final = 1.2e-3
"""Largest drift between the two clocks, seconds a second: quartz clocks of cameras stay below 1e-4, and a tenfold
margin for poor ones."""
FIRST_JITTER_S: Final = 0.08  # one sigma of the time between trigger and exposure at which the search begins
_MISSING_AT_END: Final = 0.5  # odds of a missing exposure before the first or after the last pair: logs begin earlier
_FALSE_TIME: Final = 1e-5  # probability of an exposure that is closer to another than the camera's shortest interval


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceModel:
    """Times of photos and events, each relative to its own origin, and the model's parameters."""

    p: Array  # (N,) middle of each photo's interval
    e: Array  # (M,) from the middle of the events
    resolution_s: float  # width of a photo's interval
    interval_s: float  # time between exposures that matches are weighed with
    least_s: float  # time between exposures that none goes below
    jitter_s: float = field(default_factory=lambda: FIRST_JITTER_S)  # one sigma
    # no_event, no_photo: odds that a photo's event is missing, and an event's photo
    no_event: float = 0.1
    no_photo: float = 0.1
    chains: Chains | None = None  # what the pictures show, None where they were not asked

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
        """(H C,) how likely it is, against an exposure at any time, that photo i has none of the events.

        No exposure lies closer to an event than the camera's least interval: where the photo's time leaves no room
        between the intervals around the events, it is one of them.
        """
        reach = self.least_s + 0.5 * self.resolution_s + 2.0 * self.jitter_s
        expected = offset[:, None] + (1.0 + drift[:, None]) * self.e[self._near(i, reach, offset, drift)]
        width = self.resolution_s + 4.0 * self.jitter_s
        places, least = (expected - self.p[i]) / width + 0.5, self.least_s / width
        begins = np.concatenate([np.zeros((len(offset), 1)), np.clip(places + least, 0.0, 1.0)], axis=1)
        ends = np.concatenate([np.clip(places - least, 0.0, 1.0), np.ones((len(offset), 1))], axis=1)
        room = np.maximum(ends - begins, 0.0).sum(axis=1)
        room = np.maximum(room, _FALSE_TIME)
        if self.chains is None:
            return np.asarray(room)
        return np.asarray(np.minimum(room[:, None], self.chains.alone(i, offset, drift)).ravel())

    def _near(self, i: int, reach_s: float, offset: Array, drift: Array) -> slice:
        """Events within reach of a photo under any of the clocks."""
        under = (self.p[i] + np.array([-reach_s, reach_s])[:, None] - offset) / (1.0 + drift)
        return slice(*np.searchsorted(self.e, [under[0].min(), under[1].max()]).tolist())

    def regular(self) -> "SequenceModel":
        """The same for exposures at intervals as even as these.

        At even intervals a clock that is off by whole intervals aligns photos with events, too, so that a coincidence
        counts only by the variation of the intervals, not by a full interval.
        """
        steps = np.diff(self.e)
        spread = mad_sigma(steps - np.median(steps))
        widest = max(self.resolution_s, float(np.sqrt(2.0 * np.pi)) * max(self.jitter_s, spread))
        return replace(self, interval_s=min(self.interval_s, widest))


@dataclass(frozen=True, slots=True)
class ClockGrid:
    """Clocks around a given one: offsets (H,) in seconds and drifts (H,); half widths bound the band of events."""

    offset: Array
    drift: Array
    centre: tuple[float, float]
    reach_s: float

    def band(self, model: SequenceModel) -> tuple[Indices, int]:
        """First event of each photo's band, and the width of all bands."""
        expected = self.centre[0] + (1.0 + self.centre[1]) * model.e
        reach = self.reach_s + 0.5 * model.resolution_s + 4.5 * model.jitter_s
        first = np.searchsorted(expected, model.p - reach)
        last = np.searchsorted(expected, model.p + reach)
        return first, max(1, int((last - first).max()))


def clock_grid(model: SequenceModel, offset: float, drift: float, reach_s: float, drift_reach_s: float) -> ClockGrid:
    """A grid as fine as the jitter: offsets within reach_s, drifts that move the ends by up to drift_reach_s."""
    step = 0.8 * max(model.jitter_s, 0.04 * model.resolution_s)
    half = max(0.5 * float(np.ptp(model.e)), 1e-3)
    offsets = offset + step * np.arange(-np.ceil(reach_s / step), np.ceil(reach_s / step) + 1)
    count = np.ceil(drift_reach_s / (2.0 * step))
    drifts = drift + 2.0 * step / half * np.arange(-count, count + 1)
    drifts = np.unique(np.clip(drifts, -MOST_DRIFT, MOST_DRIFT))
    both = np.meshgrid(offsets, drifts, indexing="ij")
    return ClockGrid(both[0].ravel(), both[1].ravel(), (offset, drift), reach_s + drift_reach_s + 2.0 * step)


@dataclass(slots=True)
class Forward:
    """Sums over all alignments that end with a match."""

    evidence: Array  # (H,) logarithm of the sum over all alignments
    rows: Array  # (N, H C, B) each divided by the exponential of scales (N, H C); empty unless asked for
    scales: Array


def forward(model: SequenceModel, grid: ClockGrid, *, backward: bool = False, keep: bool = False) -> Forward:
    """The forward algorithm over the photos, or from the last one back.

    With m the weight of a match, a(i) of a photo without event, s of an event without photo and t of one missing at an
    end,

        F[i, j] = m[i, j] (t^(i + j) + G[i - 1, j - 1])
        G[i, j] = sum over i' <= i, j' <= j of F[i', j'] a(i' + 1) ... a(i) s^(j - j')
    """
    first, width = grid.band(model)
    count, total, clocks = len(model.p), len(model.e), len(grid.offset) * model.hypotheses
    s, log_t = model.no_photo, float(np.log(_MISSING_AT_END))
    columns = np.arange(width + 1)
    decay = np.tril(s ** np.maximum(columns[1:, None] - columns[None, 1:], 0).astype(np.float64)).T
    sums, scale = np.zeros((clocks, width + 1)), np.zeros(clocks)
    alone = np.stack([model.alone(i, grid.offset, grid.drift) for i in range(count)])
    log_alone = log_t + np.log(alone[::-1] if backward else alone)
    log_before = np.concatenate([np.zeros((1, clocks)), np.cumsum(log_alone, axis=0)])
    evidence = np.full(clocks, -np.inf)
    rows = np.zeros((count, clocks, width)) if keep else np.zeros((0, 0, 0))
    scales = np.zeros((count, clocks)) if keep else np.zeros((0, 0))
    before: int | None = None
    for step in range(count):
        i = count - 1 - step if backward else step
        weight = model.weights(i, int(first[i]), width, grid.offset, grid.drift)
        lo = int(first[i])
        chains = model.chains
        if chains is not None and step and (chains.ends(i) if backward else chains.starts(i)):
            sums, scale = _over_hypotheses(sums, scale, model.hypotheses)
        if backward:
            weight, lo = weight[:, ::-1], total - lo - width
        if before is not None and lo != before:
            at = columns + (lo - before)
            sums = sums[:, np.minimum(at, width)] * s ** np.maximum(at - width, 0)
        before = lo
        leads = log_before[step][:, None] + log_t * np.maximum(lo + columns[:-1], 0)
        leads = np.exp(np.clip(leads - scale[:, None], -700.0, 700.0))
        found = weight * (leads + sums[:, :-1])
        sums = model.no_event * alone[i][:, None] * sums
        sums[:, 1:] += found @ decay
        after = log_t * np.maximum(total - 1 - lo - columns[:-1], 0)
        top = after.max()
        with np.errstate(divide="ignore"):
            left = np.log(found @ np.exp(after - top)) + top + log_before[count] - log_before[step + 1]
        evidence = np.logaddexp(evidence, left + scale)
        if keep:
            rows[i], scales[i] = (found[:, ::-1] if backward else found), scale
        largest = np.maximum(sums.max(axis=1), leads[:, 0])
        sums /= largest[:, None]
        scale += np.log(largest)
    evidence = np.logaddexp.reduce(evidence.reshape(-1, model.hypotheses), axis=1) - np.log(model.hypotheses)
    return Forward(evidence, rows, scales)


def _over_hypotheses(sums: Array, scale: Array, count: int) -> tuple[Array, Array]:
    """Sums and their scales where a chain of photos ends: the mean over its hypotheses stands for all of the next."""
    top = scale.reshape(-1, count).max(axis=1, keepdims=True)
    shares = np.exp(scale.reshape(-1, count) - top) / count
    mean = np.einsum("hc,hcb->hb", shares, sums.reshape(len(top), count, -1))
    return np.repeat(mean, count, axis=0), np.repeat(top.ravel(), count)


def posterior(model: SequenceModel, grid: ClockGrid, total: float) -> Array:
    """(N, B) probability of each photo and event, summed over the clocks of a grid."""
    first, width = grid.band(model)
    result = np.zeros((len(model.p), width))
    most = max(1, 4_000_000 // max(1, len(model.p) * width * model.hypotheses))
    for start in range(0, len(grid.offset), most):
        part = replace(grid, offset=grid.offset[start : start + most], drift=grid.drift[start : start + most])
        ahead, back = forward(model, part, keep=True), forward(model, part, backward=True, keep=True)
        for i in range(len(model.p)):
            weight = model.weights(i, int(first[i]), width, part.offset, part.drift)
            with np.errstate(divide="ignore", invalid="ignore"):
                both = np.log(ahead.rows[i]) + np.log(back.rows[i]) - np.log(weight)
                both += (ahead.scales[i] + back.scales[i] - total - np.log(model.hypotheses))[:, None]
                result[i] += np.where(weight > 0.0, np.exp(np.minimum(both, 0.0)), 0.0).sum(axis=0)
    return result

"""Photos of several flights in one folder, beside the logs of these flights: which photo belongs to which log.

A camera's clock is one for all flights of a day. Camera events tell it by each log alone, so that logs which find the
same clock for different photos are of one camera. Tracks tell it by the time zone in which every photo lies in some
log. Nothing else decides: logs that find different clocks may be those of other vehicles, and logs of vehicles with
different system ids are.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from telemetry.formats.log.log_data import FlightLog
from telemetry.ingest.pairing.clock_offset import SPAN_MARGIN_S, ZONES_S
from telemetry.ingest.pairing.event_pairing import JUMP_LEAST_PHOTOS, LEAST_JUMP_S, Pairing
from telemetry.ingest.pairing.sequence_model import MOST_DRIFT
from telemetry.samples.timeline import Timeline

Array = NDArray[np.float64]

LOG_LEAST_SHARE: Final = 0.5  # a log belongs to photos if this share of the shorter of both is paired


def of_one_vehicle(logs: Iterable[FlightLog]) -> bool:
    """Whether logs may be of one vehicle: what a ground station recorded names it by its system id."""
    return len({log.vehicle for log in logs if log.kind == "tlog"}) < 2


def logs_of_one_clock(
    pairings: Mapping[int, Pairing],
    times: Array,
    *,
    pair_some: Callable[[int, Sequence[int]], Pairing],
    same_flight: Callable[[int, int], bool],
) -> list[int]:
    """The logs that find one clock for different photos; fewer than two if that is not certain.

    A log of a mission that was flown twice fits the photos of both flights: it is asked again about those that no other
    log has.

    Args:
        pairings: of all photos with the events of each log, by the log's key.
        times: (N,) of the photos by the camera, NaN where unknown.
        pair_some: pairs some photos with the events of a log.
        same_flight: whether two logs record one flight, by autopilot and ground station perhaps.

    Returns:
        Keys in order of time.
    """
    sure = {key: photos for key, pairing in pairings.items() if (photos := _sure(pairing))}
    groups = [_joined(key, sure, pairings, times) for key in sure]
    best = max(groups, key=lambda keys: sum(len(sure[key]) for key in keys), default=[])
    for key in [key for key in pairings if best and key not in best]:
        taken = {i for own in best for i in sure[own]}
        rest = [i for i in range(len(times)) if i not in taken]
        again = pair_some(key, rest) if len(rest) > 1 else Pairing()
        found = {**sure, key: [rest[i] for i in _sure(again)]}
        if found[key] and _same_clock(best[0], key, found, {**pairings, key: again}, times):
            sure, best = found, [*best, key]
    for key in pairings.keys() - set(best):  # another vehicle's log that fits the same photos
        fitting = {i for i, _ in pairings[key].pairs}
        for own in best:
            common = len(fitting.intersection(sure[own]))
            if common >= LOG_LEAST_SHARE * len(sure[own]) and not same_flight(key, own):
                return []
    return sorted(best, key=lambda key: float(np.median(times[sure[key]])))


def _sure(pairing: Pairing) -> list[int]:
    """The photos whose events are certain; none if they are few, or if more than one clock fits."""
    if pairing.how != "time" or pairing.offset_s is None or pairing.ambiguous or pairing.jumps:
        return []
    photos = [i for i, _ in pairing.pairs if i not in pairing.doubtful]
    return photos if len(photos) >= JUMP_LEAST_PHOTOS else []


def _joined(first: int, sure: Mapping[int, Sequence[int]], pairings: Mapping[int, Pairing], times: Array) -> list[int]:
    """A log and those that find its clock for other photos, the ones with most photos first."""
    joined = [first]
    for key in sorted(sure, key=lambda key: -len(sure[key])):
        taken = {i for other in joined for i in sure[other]}
        if key not in joined and taken.isdisjoint(sure[key]) and _same_clock(first, key, sure, pairings, times):
            joined.append(key)
    return joined


def _same_clock(
    a: int, b: int, sure: Mapping[int, Sequence[int]], pairings: Mapping[int, Pairing], times: Array
) -> bool:
    between_s = abs(float(np.median(times[sure[a]]) - np.median(times[sure[b]])))
    apart_s = abs((pairings[a].offset_s or 0.0) - (pairings[b].offset_s or 0.0))
    return apart_s <= LEAST_JUMP_S + MOST_DRIFT * between_s


def nearest_span(times: Array, spans: Sequence[tuple[float, float]]) -> NDArray[np.int64]:
    """(N,) index of the span of time that each time lies in, or nearest to."""
    starts, ends = np.array(spans, dtype=np.float64).T
    apart = np.maximum(np.maximum(starts - times[:, None], times[:, None] - ends), 0.0)
    return np.asarray(np.argmin(apart, axis=1))


def zone_of_all(times: Array, timelines: Sequence[Timeline], *, zone_known: bool) -> float | None:
    """The only time zone under which each photo lies in the flight of exactly one log; None if there is no such one.

    Args:
        times: (N,) of the photos by the camera. timelines: of the logs.
        zone_known: whether the times are UTC already, so that no other zone is possible.
    """
    spans = [timeline.span for timeline in timelines]
    if len(spans) < 2 or any(span is None for span in spans):
        return None
    starts, ends = np.array(spans, dtype=np.float64).T
    zones = (0.0,) if zone_known else ZONES_S
    held = {}
    for zone in zones:
        at = (times - zone)[:, None]
        inside = (at >= starts - SPAN_MARGIN_S) & (at <= ends + SPAN_MARGIN_S)
        if inside.any(axis=1).all():
            held[zone] = bool((inside.sum(axis=1) == 1).all())
    if len(held) != 1:
        return None
    ((zone, only_one_each),) = held.items()
    return zone if only_one_each else None

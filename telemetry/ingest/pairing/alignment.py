"""The result of matching two sequences of exposures: probabilities of pairings, and the best alignment."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_LEAST_PROBABILITY: Final = 0.02  # events that a photo has with less probability are not listed as its alternatives


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceMatch:
    """Probabilities of pairings.

    Attributes:
        events: (K,) index of each event, without repetitions.
        first: (N,) index into `events` of column 0 of a photo's row.
        probability: (N, B) of each photo and event.
        offset_s: photo time minus event time in the middle of the events. drift: rate of the photo's clock minus one.
        resolution_s: of the photo's clock. jitter_s: of the trigger, one sigma.
        by_pictures: whether the pictures were asked, too.
        other_clock: probability that the clocks differ by another offset, some intervals away.
    """

    events: Indices
    first: Indices
    probability: Array
    offset_s: float
    drift: float
    resolution_s: float
    jitter_s: float
    by_pictures: bool = False
    other_clock: float = 0.0

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
        least = _LEAST_PROBABILITY
        return bool(self.other_clock > least and self.probability[photo].sum() < 1.0 - least)

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

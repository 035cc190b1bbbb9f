"""The pair graph of a set of photos: features of all, matches of the pairs worth trying, start values as they come.

Which pairs are worth trying depends on where the photos look, and that depends on the tilt, which only pairs tell: so
pairs in order of time come first, then near ones, then more for photos that have few.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoswarm.frame import Frame
from orthoswarm.picture import PictureError
from orthoswarm.swarm.features import FINE_PIXELS, WORKING_PIXELS, Features, detect
from orthoswarm.swarm.pairs import Pair, consecutive, match_features, nearby
from orthoswarm.swarm.plane import Ints, Records
from orthoswarm.swarm.start2d import Start2D, start_in_plane

Gray = NDArray[np.uint8]
ReadGray = Callable[[Frame], Gray]
Progress = Callable[[str, int, int], None]
A = TypeVar("A")
B = TypeVar("B")

REACH_SHARE = 0.68
_WIDE_REACH_SHARE = 0.8
_FIRST_COUNT = 3
_COUNT = 6
_MORE_COUNT = 12
_ENOUGH_PAIRS = 5
_WEAK_PAIRS = 2
_WEAK_MATCHES = 40


@dataclass(slots=True)
class PairGraphBuilder:
    """Features and matches of N photos, growing.

    Attributes:
        frames: the photos. records: what they recorded. read_gray: gives a photo's grey values at any size.
        workers: threads (OpenCV and numpy let go of the interpreter); results do not depend on it.
        features: of each photo. tried: pair -> match (empty where it failed).
        damaged: photo -> why it cannot be read.
    """

    frames: Sequence[Frame]
    records: Records
    read_gray: ReadGray
    workers: int = 1
    progress: Progress | None = None
    features: list[Features] = field(default_factory=list)
    tried: dict[tuple[int, int], NDArray[np.int32]] = field(default_factory=dict)
    damaged: dict[int, str] = field(default_factory=dict)

    def detect_all(self) -> None:
        """Find the features of all photos."""
        photos = list(range(len(self.frames)))
        self.features = list(self._map("features", self._detect, photos))

    def try_pairs(self, pairs: Ints) -> None:
        """Match pairs that were not tried yet."""
        fresh = [(int(a), int(b)) for a, b in pairs if (int(a), int(b)) not in self.tried]
        for pair, match in zip(fresh, self._map("pairs", self._match, fresh), strict=True):
            self.tried[pair] = match

    def pairs(self) -> list[Pair]:
        """The matched pairs in order."""
        return [Pair(a, b, m) for (a, b), m in sorted(self.tried.items()) if len(m)]

    def degree(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pairs and matches of each photo, int64 (N,) both."""
        pairs, matches = np.zeros(len(self.frames), np.int64), np.zeros(len(self.frames), np.int64)
        for (a, b), m in self.tried.items():
            for k in (a, b):
                pairs[k] += len(m) > 0
                matches[k] += len(m)
        return pairs, matches

    def near(self, start: Start2D, count: int, share: float, only: NDArray[np.bool_] | None = None) -> Ints:
        """Pairs whose pictures should overlap by the start; `only` bool (N,) asks for one of them to be set."""
        reach = share * start.metres * np.hypot(self.records.width, self.records.rows)
        pairs = nearby(start.middle(), reach, self.records.segment, count)
        return pairs if only is None or not len(pairs) else pairs[only[pairs].any(1)]

    def start(self) -> Start2D:
        """Start values by the pairs found so far."""
        return start_in_plane(self.records, self.pairs(), self.features)

    def redetect(self, weak: NDArray[np.bool_]) -> None:
        """Find features of weak photos on larger pictures and forget their failed pairs."""
        rows = np.flatnonzero(weak)
        found = self._map("features", lambda k: self._detect(k, FINE_PIXELS), [int(k) for k in rows])
        for k, features in zip(rows.tolist(), found, strict=True):
            self.features[k] = features
        self.tried = {pair: m for pair, m in self.tried.items() if not (weak[pair[0]] or weak[pair[1]])}

    def _detect(self, k: int, pixels: int = WORKING_PIXELS) -> Features:
        frame = self.frames[k]
        try:
            gray = self.read_gray(frame)
        except PictureError as error:
            self.damaged[k] = str(error)
            return Features.none(frame.width, frame.height)
        rows, columns = gray.shape
        if abs(columns * frame.height - rows * frame.width) > 0.02 * columns * frame.height:
            self.damaged[k] = f"{frame.image} is {columns}x{rows}, not as its header says; copy it again"
            return Features.none(frame.width, frame.height)
        return detect(gray, frame.width, frame.height, pixels)

    def _match(self, pair: tuple[int, int]) -> NDArray[np.int32]:
        return match_features(self.features[pair[0]], self.features[pair[1]])

    def _map(self, stage: str, function: Callable[[A], B], items: Sequence[A]) -> Iterable[B]:
        if self.workers > 1 and len(items) > 1:
            with ThreadPoolExecutor(self.workers) as pool:
                yield from self._counted(stage, pool.map(function, items), len(items))
        else:
            yield from self._counted(stage, map(function, items), len(items))

    def _counted(self, stage: str, results: Iterable[B], total: int) -> Iterable[B]:
        for n, result in enumerate(results):
            if self.progress:
                self.progress(stage, n + 1, total)
            yield result


def build_pair_graph(builder: PairGraphBuilder) -> Start2D:
    """Find features, pairs and start values of all photos; the builder holds what was found."""
    records = builder.records
    builder.detect_all()
    builder.try_pairs(consecutive(records.vehicle, records.time_s))
    start = builder.start()
    for count in (_FIRST_COUNT, _COUNT):
        builder.try_pairs(builder.near(start, count, REACH_SHARE))
        start = builder.start()
    few = builder.degree()[0] < _ENOUGH_PAIRS
    if few.any():
        builder.try_pairs(builder.near(start, _MORE_COUNT, REACH_SHARE, few))
        start = builder.start()
    pairs, matches = builder.degree()
    weak = (pairs < _WEAK_PAIRS) | (matches < _WEAK_MATCHES)
    weak[list(builder.damaged)] = False
    if weak.any():
        builder.redetect(weak)
        builder.try_pairs(builder.near(start, _MORE_COUNT, _WIDE_REACH_SHARE, weak))
        builder.try_pairs(consecutive(records.vehicle, records.time_s))
        start = builder.start()
    return start

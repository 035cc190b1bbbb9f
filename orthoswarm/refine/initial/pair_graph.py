"""Builds the pair graph of photos: features, matches of candidate pairs, and the improving initial orientation.

Candidate pairs depend on where the photos look, hence on the tilt, which is only known from pairs: so pairs in order
of time are matched first, then near ones, then more for photos with few pairs.

Thresholds without another source were chosen on four real flights.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Flags, Indices, Ints
from orthoswarm.model.frame import Frame
from orthoswarm.model.task_runner import Progress, Run, serial
from orthoswarm.raster.picture_file import PictureError
from orthoswarm.refine.features.pair_matching import Pair, consecutive, match_features, nearby
from orthoswarm.refine.features.sift_features import SIFT_PIXELS, SiftFeatures, detect
from orthoswarm.refine.features.working_pictures import ReadGray
from orthoswarm.refine.initial.initial_orientation import InitialOrientation, find_initial_orientation
from orthoswarm.refine.initial.planar_similarity import PhotoRecords

_SIFT_FINE_PIXELS: Final = 640 * 480  # pixels of reduced pictures that matched too few others (four real flights)
_PAIR_REACH_SHARE: Final = 0.68  # photos nearer than this share of the footprint's diagonal may overlap
_WEAK_REACH_SHARE: Final = 0.8  # the same for photos with few matches
_PAIRS_FIRST: Final = 3  # neighbours that each photo tries first, before the tilt is known
_PAIRS_USUAL: Final = 6  # ... and then
_PAIRS_MORE: Final = 12  # ... and for photos with few pairs
_ENOUGH_PAIRS: Final = 5  # photos with fewer pairs try more neighbours
_WEAK_PAIRS: Final = 2  # photos with fewer pairs get finer features
_WEAK_MATCHES: Final = 40  # ... and those with fewer matches in all
_PAIRS_PER_TASK: Final = 64  # pairs that a worker matches at a time (for speed alone)
_HEADER_SIZE_SHARE: Final = 0.02  # a picture's shape may differ from its header's by so much


@dataclass(slots=True, kw_only=True)
class PairGraphBuilder:
    """Features and matches of N photos, extended step by step.

    run: executes the feature and matching tasks; results do not depend on it. progress: called with stage, number done,
    total. tried: pair -> match (empty where it failed). damaged: photo -> why it cannot be read.
    """

    frames: Sequence[Frame]
    records: PhotoRecords
    read_gray: ReadGray
    run: Run = serial
    progress: Progress | None = None
    features: list[SiftFeatures] = field(default_factory=list)
    tried: dict[tuple[int, int], Ints] = field(default_factory=dict)
    damaged: dict[int, str] = field(default_factory=dict)

    def detect_all(self) -> None:
        """Find the features of all photos."""
        self.features = [SiftFeatures.none(f.width, f.height) for f in self.frames]
        self._detect(list(range(len(self.frames))), SIFT_PIXELS)

    def try_pairs(self, pairs: Ints) -> None:
        """Match the pairs that have not been tried yet."""
        fresh = [(int(a), int(b)) for a, b in pairs if (int(a), int(b)) not in self.tried]
        size = _PAIRS_PER_TASK
        chunks = [fresh[k : k + size] for k in range(0, len(fresh), size)]
        tasks = [(chunk, {k: self.features[k] for pair in chunk for k in pair}) for chunk in chunks]
        done = 0
        for chunk, matches in zip(chunks, self.run(match_chunk, tasks), strict=True):
            self.tried.update(zip(chunk, matches, strict=True))
            done += len(chunk)
            self._report("pairs", done, len(fresh))

    def pairs(self) -> list[Pair]:
        """The matched pairs in order."""
        return [Pair(a, b, m) for (a, b), m in sorted(self.tried.items()) if len(m)]

    def degree(self) -> tuple[Indices, Indices]:
        """Numbers of pairs and of matches of each photo, both int64 (N,)."""
        pairs, matches = np.zeros(len(self.frames), np.int64), np.zeros(len(self.frames), np.int64)
        for (a, b), m in self.tried.items():
            for k in (a, b):
                pairs[k] += len(m) > 0
                matches[k] += len(m)
        return pairs, matches

    def near(self, start: InitialOrientation, count: int, share: float, only: Flags | None = None) -> Ints:
        """Pairs that should overlap according to the initial orientation; at least one of each in `only`, bool (N,)."""
        reach = share * start.metres * np.hypot(self.records.width, self.records.rows)
        pairs = nearby(start.middle(), reach, self.records.segment, count)
        return pairs if only is None or not len(pairs) else pairs[only[pairs].any(1)]

    def start(self) -> InitialOrientation:
        """Start values from the pairs found so far."""
        return find_initial_orientation(self.records, self.pairs(), self.features)

    def redetect(self, weak: Flags) -> None:
        """Detect features of weakly connected photos again on larger pictures, and drop their pairs."""
        self._detect(np.flatnonzero(weak).tolist(), _SIFT_FINE_PIXELS)
        self.tried = {pair: m for pair, m in self.tried.items() if not (weak[pair[0]] or weak[pair[1]])}

    def _detect(self, photos: list[int], pixels: int) -> None:
        task = partial(features_of, read_gray=self.read_gray, pixels=pixels)
        found: Iterable[SiftFeatures | str] = self.run(task, [self.frames[k] for k in photos])
        for n, (k, result) in enumerate(zip(photos, found, strict=True)):
            if isinstance(result, str):
                self.damaged[k] = result
            else:
                self.features[k] = result
            self._report("features", n + 1, len(photos))

    def _report(self, stage: str, done: int, total: int) -> None:
        if self.progress:
            self.progress(stage, done, total)


def features_of(frame: Frame, *, read_gray: ReadGray, pixels: int) -> SiftFeatures | str:
    """Features of a photo, or the reason why it cannot be used."""
    try:
        gray = read_gray(frame)
    except PictureError as error:
        return error.reason
    rows, columns = gray.shape
    if abs(columns * frame.height - rows * frame.width) > _HEADER_SIZE_SHARE * columns * frame.height:
        return f"{frame.image} is {columns}x{rows}, not as its header says; copy it again"
    return detect(gray, frame.width, frame.height, pixels)


def match_chunk(task: tuple[list[tuple[int, int]], dict[int, SiftFeatures]]) -> list[Ints]:
    """Match some pairs; the task contains the pairs and the features of their photos."""
    pairs, features = task
    return [match_features(features[a], features[b]) for a, b in pairs]


def build_pair_graph(builder: PairGraphBuilder) -> InitialOrientation:
    """Find features, pairs and start values of all photos; features and pairs are left in the builder."""
    records = builder.records
    builder.detect_all()
    builder.try_pairs(consecutive(records.vehicle, records.time_s))
    start = builder.start()
    for count in (_PAIRS_FIRST, _PAIRS_USUAL):
        builder.try_pairs(builder.near(start, count, _PAIR_REACH_SHARE))
        start = builder.start()
    few = builder.degree()[0] < _ENOUGH_PAIRS
    if few.any():
        builder.try_pairs(builder.near(start, _PAIRS_MORE, _PAIR_REACH_SHARE, few))
        start = builder.start()
    pairs, matches = builder.degree()
    weak = (pairs < _WEAK_PAIRS) | (matches < _WEAK_MATCHES)
    weak[list(builder.damaged)] = False
    if weak.any():
        builder.redetect(weak)
        builder.try_pairs(builder.near(start, _PAIRS_MORE, _WEAK_REACH_SHARE, weak))
        builder.try_pairs(consecutive(records.vehicle, records.time_s))
        start = builder.start()
    return start

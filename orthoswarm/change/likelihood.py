"""From what is measured of cells to the probabilities of what has become of them.

Four cases exclude each other: unchanged; under water; buried or ploughed up; a building gone or its roof torn. Their
log-likelihoods, but for a constant, are smooth functions of what is measured: sums of some sigmoids of weighted sums.
The weights were fitted by maximum likelihood on simulated cities, whose maps were also given in another season, darker,
with other detail and coarser (`python -m benchmarks.accuracy.change fit`), and stand in weights.npz.
"""

from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from orthoswarm.model.arrays import Floats

CASES: Final = ("unchanged", "water", "rubble or earth", "building gone or roof damaged")
MOST: Final = 5.0  # values farther from the usual ones, in standard deviations, say no more
_FILE: Final = Path(__file__).with_name("weights.npz")


class Weights(NamedTuple):
    """Weights of the likelihoods."""

    mean: Floats  # (features,), of what is measured
    spread: Floats  # (features,), of what is measured
    first: Floats  # (features + 1, hidden)
    second: Floats  # (hidden + 1, cases); the last rows are constants


@lru_cache(maxsize=1)
def fitted() -> Weights:
    """The weights that were fitted."""
    with np.load(_FILE) as file:
        return Weights(*(file[name] for name in Weights._fields))


def probabilities(values: Floats, weights: Weights | None = None) -> Floats:
    """Probabilities of the CASES, float32 (..., cases), of what is measured, float32 (..., features)."""
    w = weights or fitted()
    x = np.clip((values - w.mean) / w.spread, -MOST, MOST)
    hidden = np.tanh(x @ w.first[:-1] + w.first[-1])
    z = hidden @ w.second[:-1] + w.second[-1]
    z = np.exp(z - z.max(-1, keepdims=True))
    return np.asarray(z / z.sum(-1, keepdims=True), np.float32)

"""The probability that cells have changed, from the structure, roughness and hue of map and pictures.

What both have in common is measured as 2 <m, p> / (<m, m> + <p, p> + f), with <> the mean over the surroundings of a
cell at several scales: 1 where they are alike, 0 where they differ, and also where neither has any structure, which
the share of structure, (<m, m> + <p, p>) / (<m, m> + <p, p> + f), tells apart.

Four cases exclude each other: unchanged; under water; buried or ploughed up; a building gone or its roof torn. Their
log-likelihoods, but for a constant, are smooth functions of what is measured: sums of some sigmoids of weighted sums.
The weights were fitted by maximum likelihood on simulated cities, whose maps were also given in another season, darker,
with other detail and coarser (`python -m benchmarks.accuracy.change fit`), and stand in weights.npz.
"""

from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np

from orthoswarm.change.looks import CellLooks, ToneModel, mean_around, on_cells, order_of
from orthoswarm.change.seen_ground import SeenGround
from orthoswarm.change.structure import NOISE_GRAY, Structure, blurred
from orthoswarm.model.arrays import Flags, Floats

SCALES_M: Final = (2.0, 4.0, 8.0)  # sigmas of the surroundings of structure
_FINE_SCALES_M: Final = (2.0, 4.0)  # of roughness and order
_HUE_SCALES_M: Final = (1.5, 3.0, 6.0)
_LITTLE: Final = 0.1  # power of structure that is as good as none
_AROUND_DARKEST_M: Final = 24.0
_DARK: Final = 55.0  # grey value of the darkest place around on a clear day
_WHITE: Final = 225.0  # grey value of haze
_LEAST_WEIGHT: Final = 0.02  # of pictures: one that sees a place 43 degrees off nadir counts so little
_SAME: Final = 0.3  # what has so much in common is the same ground
_ENOUGH: Final = 200  # cells that tell the usual ratio of contrasts
CASES: Final = ("unchanged", "water", "rubble or earth", "building gone or roof damaged")
MOST: Final = 5.0  # values farther from the usual ones, in standard deviations, say no more
_FILE: Final = Path(__file__).with_name("weights.npz")


def unveiled(contrast: Floats, gray: Floats, gsd_m: float) -> tuple[Floats, Floats]:
    """Contrast as it would be without haze, and the share of light that is haze, both float32 (rows, columns).

    The darkest place around is as dark as the haze before it lets it be (the dark channel of He, Sun, Tang 2009).
    """
    side = round(_AROUND_DARKEST_M / gsd_m) | 1
    darkest = cv2.erode(gray, np.ones((side, side), np.uint8), borderType=cv2.BORDER_REFLECT)
    darkest = blurred(darkest, 0.25 * side)
    veil = np.clip((darkest - _DARK) / (_WHITE - _DARK), 0.0, 0.9)
    return np.asarray(contrast / (1.0 - veil)), np.asarray(veil)


def measured(
    seen: SeenGround, before: Structure, gray: Floats, valid: Flags, *, now: CellLooks, then: CellLooks, drawn: Flags,
    tone: ToneModel, per_cell: int, cell_m: float,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Measure a block of cells.

    Args:
        seen: what the pictures show, on pixels. before, gray, valid: structure and grey values of the map there, and
            where it has some.
        now, then: looks of the cells in the orthoimage and on the map. drawn: where the orthoimage shows them.
        tone: the scene's. per_cell: pixels along a cell. cell_m: its side.

    Returns:
        What the probability is computed from, float32 (rows, columns, features); how much of each cell pictures see
        and the map has, 0 to 1; and the share of its light that is haze, less that of the map (large white roofs are
        no haze).
    """
    gsd_m = cell_m / per_cell
    both = ((seen.weight > _LEAST_WEIGHT) & valid).astype(np.float32)
    contrast, veil = unveiled(seen.contrast, np.where(both > 0, seen.gray, 255.0).astype(np.float32), gsd_m)
    on_map, clear = unveiled(before.contrast, np.where(valid, gray, 255.0).astype(np.float32), gsd_m)
    product = before.field * seen.field
    parts = [
        product[..., 0] + product[..., 1], product[..., 2] + product[..., 3], before.power,
        np.maximum(seen.same, 0.0), seen.power - seen.same, np.log((contrast + NOISE_GRAY) / (on_map + NOISE_GRAY)),
    ]  # fmt: skip
    count = on_cells(both, per_cell)
    sums = np.dstack([on_cells(part * both, per_cell) for part in parts])
    cells = np.asarray(sums / np.maximum(count, 1e-3)[..., None], np.float32)
    values = _structure_values(cells, count, cell_m)
    known = count * drawn
    for scale in _FINE_SCALES_M:
        for looks in (now, then):
            mean = [mean_around(v, scale / cell_m, known) for v in (looks.spots, looks.edges, looks.order)]
            values += [np.log(mean[0] + 1.0), np.log(mean[1] + 1.0), order_of(mean[2])]
    far, difference = tone.differs(then.color, now.color)
    values += [np.log(mean_around(far, scale / cell_m, known) + 0.2) for scale in _HUE_SCALES_M]
    difference = mean_around(difference, _HUE_SCALES_M[0] / cell_m, known)
    values += [difference, np.log(difference + 0.01), np.log(on_cells(seen.weight, per_cell) + _LEAST_WEIGHT)]
    return np.stack(values, -1).astype(np.float32), count, on_cells(np.maximum(veil - clear, 0.0), per_cell)


def _structure_values(cells: Floats, count: Floats, cell_m: float) -> list[Floats]:
    """Structure in common at each scale, with its share, what pictures do not agree on, and the ratio of contrasts."""
    means = [mean_around(cells, scale / cell_m, count) for scale in SCALES_M]

    def shares(mean: Floats) -> tuple[Floats, Floats, Floats]:
        total = mean[..., 2] + mean[..., 3]
        return 2 * mean[..., 0] / (total + _LITTLE), 2 * mean[..., 1] / (total + _LITTLE), total / (total + _LITTLE)

    same = (shares(means[-1])[1] > _SAME) & (count > 0.5)
    usual = float(np.median(means[-1][..., 5][same])) if same.sum() > _ENOUGH else 0.0
    out: list[Floats] = []
    for mean in means:
        ratio = mean[..., 5] - np.float32(usual)
        out += [*shares(mean), np.maximum(mean[..., 4], 0.0), np.maximum(ratio, 0.0), np.maximum(-ratio, 0.0)]
    return out


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

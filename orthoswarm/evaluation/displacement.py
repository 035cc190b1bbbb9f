"""How well an orthoimage lies on a reference: a field of displacements by masked local correlation.

Both pictures are turned into fields of normalised gradients, g / (|g| + median |g|), so that light, season and gain do
not matter; blocks of the reference are then searched for in the orthoimage. A block counts only where its correlation
has one clear peak. Pure functions on arrays; files are read by the caller.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Flags, Floats, Indices
from orthoswarm.raster.subpixel_peak import vertex

Mask = Flags


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldSettings:
    """How displacements are measured."""

    gsd_m: float = 0.3  # pixel of the grid on which both pictures are compared
    block_m: float = 36.0  # side of a block
    step_m: float = 20.0  # distance of blocks
    search_m: float = 8.0  # largest displacement that is looked for, each way
    min_peak: float = 0.25  # least correlation of a match
    max_second: float = 0.8  # largest second peak, as a share of the first
    apart_m: float = 2.0  # a peak farther away than this is another one
    min_cover: float = 0.6  # least share of a block that both pictures must cover


@dataclass(frozen=True, slots=True)
class Displacements:
    """A field of displacements of an orthoimage against a reference."""

    position: Array  # float64 (N, 2), column and row of the blocks' centres on the common grid
    # float64 (N, 2), where the orthoimage has it minus where the reference has it: east, north, metres; NaN where
    # unmatched
    shift_m: Array
    peak: Array  # float64 (N,), height of the correlation's peak
    contrast: Array  # float64 (N,), strength of the orthoimage's gradients as a share of the reference's

    @property
    def matched(self) -> Mask:
        """Which blocks found their place, bool (N,)."""
        return np.asarray(np.isfinite(self.shift_m[:, 0]))

    @property
    def length_m(self) -> Array:
        """Length of the displacements of the matched blocks."""
        return np.asarray(np.hypot(*self.shift_m[self.matched].T))

    @classmethod
    def joined(cls, parts: list["Displacements"]) -> "Displacements":
        """Several fields as one."""
        if not parts:
            return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
        return cls(
            *(np.concatenate([getattr(p, n) for p in parts]) for n in ("position", "shift_m", "peak", "contrast"))
        )


def gradient_field(gray: Floats, valid: Mask) -> tuple[NDArray[np.complex64], Floats]:
    """Gradients east + i south, zero where invalid, and their squared length before normalisation.

    Args:
        gray: float32 (rows, columns). valid: bool of the same shape.

    Returns:
        complex64 of the same shape, normalised by |g| + the median |g| of valid pixels; float32 |g|^2.
    """
    import cv2

    smooth = cv2.GaussianBlur(np.where(valid, gray, 0).astype(np.float32), (0, 0), 1.0)
    gx = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)
    # the edge of the valid part is not an edge of the ground: blur and derivative reach four pixels
    inside = cv2.erode(valid.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=0) > 0
    length = np.sqrt(gx * gx + gy * gy)
    scale = float(np.median(length[inside])) if inside.any() else 0.0
    weight = np.where(inside, 1.0 / (length + scale + 0.05), 0.0)
    return ((gx + 1j * gy) * weight).astype(np.complex64), np.asarray(
        np.where(inside, length * length, 0.0), np.float32
    )


def _correlate(template: NDArray[Any], mask: Mask, window: NDArray[Any], cover: Mask) -> tuple[Array, Array]:
    """Normalised correlation of a block at all places in a larger window, and the energy share compared there."""
    from scipy import fft

    rows, cols = (w - t + 1 for w, t in zip(window.shape, template.shape, strict=True))
    shape = tuple(fft.next_fast_len(n) for n in window.shape)
    block = np.where(mask, template, 0)
    energy_t, energy_w = np.abs(block) ** 2, np.abs(window) ** 2
    # the energies are those of what both show: |T|^2 under the window's cover, |S|^2 under the block's mask
    dot = fft.ifft2(np.conj(fft.fft2(block, shape)) * fft.fft2(window, shape))[:rows, :cols].real
    g = [fft.rfft2(a.astype(np.float32), shape) for a in (energy_t, cover, mask, energy_w)]
    both = fft.irfft2(np.stack([np.conj(g[0]) * g[1], np.conj(g[2]) * g[3]]), shape)[:, :rows, :cols]
    total = float(energy_t.sum())
    norm = np.sqrt(np.maximum(both[0], 1e-6 * total) * np.maximum(both[1], 1e-6 * total))
    return np.asarray(dot / np.maximum(norm, 1e-9), np.float64), np.asarray(both[0] / max(total, 1e-9), np.float64)


def _peak(score: Array, s: FieldSettings) -> tuple[float, float, float] | None:
    """Row, column (subpixel) and height of a clear peak inside the searched area, else None."""
    r, c = np.unravel_index(int(score.argmax()), score.shape)
    top = float(score[r, c])
    if top < s.min_peak or r in (0, score.shape[0] - 1) or c in (0, score.shape[1] - 1):
        return None
    reach = max(2, round(s.apart_m / s.gsd_m))
    rest = score.copy()
    rest[max(0, r - reach) : r + reach + 1, max(0, c - reach) : c + reach + 1] = -1.0
    if rest.max() > s.max_second * top:
        return None
    dr = vertex(float(score[r - 1, c]), top, float(score[r + 1, c]))
    dc = vertex(float(score[r, c - 1]), top, float(score[r, c + 1]))
    return float(r) + dr, float(c) + dc, top


def block_centers(shape: tuple[int, int], s: FieldSettings) -> Indices:
    """Rows and columns (N, 2) of the blocks' upper left corners on a grid of `shape` pixels."""
    side, step = round(s.block_m / s.gsd_m), max(1, round(s.step_m / s.gsd_m))
    rows = np.arange(0, shape[0] - side + 1, step)
    cols = np.arange(0, shape[1] - side + 1, step)
    return np.stack(np.meshgrid(rows, cols, indexing="ij"), -1).reshape(-1, 2)


def displacement_field(
    ortho: Floats,
    ortho_valid: Mask,
    reference: Floats,
    reference_valid: Mask,
    *,
    settings: FieldSettings | None = None,
    offset: tuple[int, int] = (0, 0),
) -> Displacements:
    """Displacements of an orthoimage against a reference on one grid.

    Args:
        ortho: float32 (rows, columns), grey; either as large as the reference or larger by the search radius in
            pixels on every side. ortho_valid: where it shows ground. reference: float32 (rows, columns), grey.
        reference_valid: where it may be compared. settings: how to measure.
        offset: row and column of the reference's first pixel on a larger grid.

    Returns:
        One entry for each block that both cover; blocks that neither or only one covers are left out.
    """
    s = settings or FieldSettings()
    side, reach = round(s.block_m / s.gsd_m), max(1, round(s.search_m / s.gsd_m))
    spare = reach if ortho.shape == reference.shape else 0
    pad = [(spare, spare), (spare, spare)]
    g_ref, e_ref = gradient_field(reference, reference_valid)
    g_ort, e_ort = (np.pad(a, pad) for a in gradient_field(ortho, ortho_valid))
    cover = np.pad(ortho_valid, pad)
    found: list[tuple[float, ...]] = []
    for r, c in block_centers(reference.shape, s):
        here = np.s_[r : r + side, c : c + side]
        around = np.s_[r : r + side + 2 * reach, c : c + side + 2 * reach]
        mask = reference_valid[here]
        same = cover[r + reach : r + reach + side, c + reach : c + reach + side]
        usable = float(mask.mean())
        if usable < 0.25 or float((mask & same).sum()) < s.min_cover * float(mask.sum()):
            continue
        place = (offset[1] + c + 0.5 * (side - 1), offset[0] + r + 0.5 * (side - 1))
        score, share = _correlate(g_ref[here], mask, g_ort[around], cover[around])
        best = _peak(np.where(share > 0.5, score, -1.0), s)
        if best is None:
            found.append((*place, np.nan, np.nan, float(score.max()), np.nan))
            continue
        row, col, top = best
        north, east = -(row - reach) * s.gsd_m, (col - reach) * s.gsd_m
        i, j = round(row), round(col)
        theirs = float(e_ort[r + i : r + i + side, c + j : c + j + side][mask].mean())
        contrast = np.sqrt(theirs / max(float(e_ref[here][mask].mean()), 1e-9))
        found.append((*place, east, north, top, float(contrast)))
    table = np.array(found, float).reshape(-1, 6)
    return Displacements(table[:, :2], table[:, 2:4], table[:, 4], table[:, 5])


def completeness(ortho_valid: Mask, reference_valid: Mask) -> float:
    """Covered share of the reference's valid ground inside the hull of the orthoimage's own coverage."""
    import cv2

    points = cv2.findNonZero(ortho_valid.astype(np.uint8))
    if points is None:
        return 0.0
    hull = np.zeros(ortho_valid.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(points), 1)
    ground = (hull > 0) & reference_valid
    return float((ground & ortho_valid).sum()) / max(float(ground.sum()), 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """The figures of an orthoimage against a reference; lengths in metres."""

    median_m: float  # median displacement of the matched blocks
    p90_m: float  # 90 % of them are below
    p95_m: float  # 95 %
    max_m: float  # the largest
    mean_east_m: float  # mean shift east
    mean_north_m: float  # north
    unmatched_share: float  # share of the covered blocks that found no place
    share_within_1m: float  # share of all covered blocks, unmatched ones included, that lie within a metre
    blocks: int  # covered blocks
    completeness: float  # covered share of the ground within the coverage's hull
    sharpness: float  # strength of gradients as a share of the reference's, median
    seam_p95_m: float  # 95 % of the jumps between neighbouring blocks are below
    field: Displacements = field(repr=False, compare=False)

    def figures(self) -> dict[str, float | int | None]:
        """The numbers as JSON values; None where there is none."""
        names = [n for n in self.__slots__ if n != "field"]
        values = {name: getattr(self, name) for name in names}
        return {n: (None if isinstance(v, float) and not np.isfinite(v) else v) for n, v in values.items()}


def accuracy(displacements: Displacements, complete: float, step_px: float) -> Accuracy:
    """The figures of a field of displacements of all covered blocks; step_px: distance of neighbouring blocks.

    Where no block is matched, displacements are NaN.
    """
    length, matched = displacements.length_m, displacements.matched
    count, found = len(matched), len(length) > 0
    east, north = displacements.shift_m[matched].mean(0).tolist() if found else (np.nan, np.nan)
    p50, p90, p95, most = np.percentile(length, [50, 90, 95, 100]).tolist() if found else [np.nan] * 4
    jumps = np.array(list(_jumps(displacements, step_px)))
    return Accuracy(
        median_m=p50, p90_m=p90, p95_m=p95, max_m=most, mean_east_m=east, mean_north_m=north,
        unmatched_share=1.0 - len(length) / count if found else 1.0,
        share_within_1m=float((length <= 1.0).sum()) / max(count, 1), blocks=count, completeness=complete,
        sharpness=float(np.median(displacements.contrast[matched])) if found else np.nan,
        seam_p95_m=float(np.percentile(jumps, 95)) if len(jumps) else np.nan, field=displacements,
    )  # fmt: skip


def _jumps(d: Displacements, step_px: float) -> Iterator[float]:
    """Differences of displacement between neighbouring matched blocks."""
    ok = np.flatnonzero(d.matched)
    cells = {tuple(np.round(d.position[i] / step_px, 2)): i for i in ok}
    for (x, y), i in cells.items():
        for key in ((round(x + 1, 2), y), (x, round(y + 1, 2))):
            j = cells.get(key)
            if j is not None:
                yield float(np.hypot(*(d.shift_m[i] - d.shift_m[j])))

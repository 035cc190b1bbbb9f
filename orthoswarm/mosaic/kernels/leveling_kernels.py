"""The compiled parts of seam leveling: what a tile's seams show of both pictures, the solution, and its application."""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel

SLOTS = 8  # most pictures, and pairs of them, in a cell; any beyond are left as they are
BOTH = 9
"""What is summed of two pictures at the seams in a cell: pixels, three colours of the first, three of the second, log
ratio of their brightness and its square."""


@in_place_kernel
def _slot(labels, wanted):  # type: ignore[no-untyped-def]
    """Place of a label in a list that ends with zeros; it is added if there is room, else -1."""
    for k in range(len(labels)):
        if labels[k] == wanted:
            return k
        if labels[k] == 0:
            labels[k] = wanted
            return k
    return -1


@in_place_kernel
def count_pixels(packed, label, cell, labels, pixels):  # type: ignore[no-untyped-def]
    """Count the pixels of a tile's pictures by cell.

    Args:
        packed: uint32 (T, T), colours; label: int32 (T, T), whose these are, 0 = none. cell: side of the cells, pixels.
        labels: int32 (R, C, SLOTS), pixels: float32 (R, C, SLOTS): zeros, are filled.
    """
    for r in range(label.shape[0]):
        i = r // cell
        last, last_j, at = -1, -1, -1
        for c in range(label.shape[1]):
            a, j = label[r, c], c // cell
            if a == 0 or packed[r, c] >> np.uint32(24) == 0:
                continue
            if a != last or j != last_j:
                at = _slot(labels[i, j], a)
                last, last_j = a, j
            if at >= 0:
                pixels[i, j, at] += 1.0


@kernel
def sum_seams(packed, label, index, other, colors, cell, dark, bright, labels, pairs, both):  # type: ignore[no-untyped-def]
    """Sum the colours of two pictures at the same ground near seams.

    Args:
        packed, label, cell, labels: see `count_pixels`. index, other, colors: of the other pictures, see
            seam_pixels.SeamPixels. dark, bright: levels outside of which a colour is clipped.
        pairs: int32 (R, C, SLOTS, 2), the lesser label first, both: float64 (R, C, SLOTS, BOTH): zeros, are filled.
    """
    flat, flat_label, side = packed.ravel(), label.ravel(), label.shape[1]
    full = np.uint32(255)
    for n in range(len(index)):
        p = index[n]
        a, b, here, there = flat_label[p], other[n], flat[p], colors[0, n]
        if a == 0 or b == a or here >> np.uint32(24) == 0 or there >> np.uint32(24) == 0:
            continue
        i, j = p // side // cell, p % side // cell
        _slot(labels[i, j], b)
        if a > b:
            a, b, here, there = b, a, there, here
        clear = True
        for channel in range(3):
            shift = np.uint32(8 * channel)
            clear = clear and dark < (here >> shift) & full < bright and dark < (there >> shift) & full < bright
        if not clear:
            continue
        for k in range(SLOTS):
            if pairs[i, j, k, 0] == 0:
                pairs[i, j, k, 0], pairs[i, j, k, 1] = a, b
            if pairs[i, j, k, 0] == a and pairs[i, j, k, 1] == b:
                one, two = 0.0, 0.0
                both[i, j, k, 0] += 1.0
                for channel in range(3):
                    shift = np.uint32(8 * channel)
                    first, second = float((here >> shift) & full), float((there >> shift) & full)
                    both[i, j, k, 1 + channel] += first
                    both[i, j, k, 4 + channel] += second
                    one += first
                    two += second
                log = np.log(one / two)
                both[i, j, k, 7] += log
                both[i, j, k, 8] += log * log
                break


@kernel
def level_listed(colors, index, other, side, cell, labels, factors):  # type: ignore[no-untyped-def]
    """Multiply the colours of listed pixels (seam_pixels.SeamPixels) of a tile by their pictures' factors.

    Args:
        colors: uint32 (1, N), changed in place. index, other: int32 (N,). side: of the tile, pixels.
        cell, labels, factors: see `apply_factors`.
    """
    corner, has, total = np.ones((2, 2, 3), np.float32), np.zeros((2, 2), np.bool_), np.ones(3, np.float32)
    for n in range(len(index)):
        y, x = (index[n] // side + 0.5) / cell + 0.5, (index[n] % side + 0.5) / cell + 0.5
        i, j = int(y), int(x)
        fy, fx = np.float32(y - i), np.float32(x - j)
        _corners(labels, factors, i, j, other[n], corner, total, has)
        levelled = colors[0, n] & np.uint32(0xFF000000)
        for channel in range(3):
            west = corner[0, 0, channel] + fy * (corner[1, 0, channel] - corner[0, 0, channel])
            east = corner[0, 1, channel] + fy * (corner[1, 1, channel] - corner[0, 1, channel])
            shift = np.uint32(8 * channel)
            value = np.float32((colors[0, n] >> shift) & np.uint32(255)) * (west + fx * (east - west))
            levelled |= np.uint32(min(value + np.float32(0.5), np.float32(255.0))) << shift
        colors[0, n] = levelled


@kernel
def apply_factors(rgba, label, cell, labels, factors):  # type: ignore[no-untyped-def]
    """Multiply a tile's colours by their pictures' factors, bilinear between the centres of cells.

    Args:
        rgba: uint8 (T, T, 4), changed in place. label: int32 (T, T). cell: side of the cells, pixels.
        labels: int32 (R + 2, C + 2, SLOTS), of the cells of the tile and one beyond each border.
        factors: float32 (R + 2, C + 2, SLOTS, 3), and their factors.
    """
    corner, has = np.ones((2, 2, 3), np.float32), np.zeros((2, 2), np.bool_)
    _apply(rgba, label, cell, labels, factors, corner, has, np.ones((3, 3), np.float32))


@in_place_kernel
def _apply(rgba, label, cell, labels, factors, corner, has, channels):  # type: ignore[no-untyped-def]
    """What `apply_factors` does. corner, has, channels: room for the factors of four cells, and three times three."""
    half = np.float32(0.5)
    left, rise, total = channels[0], channels[1], channels[2]
    for r in range(label.shape[0]):
        y = (r + 0.5) / cell + 0.5
        i = int(y)
        fy = np.float32(y - i)
        last, last_j = 0, -1
        for c in range(label.shape[1]):
            a = label[r, c]
            if a == 0 or rgba[r, c, 3] == 0:
                continue
            x = (c + 0.5) / cell + 0.5
            j = int(x)
            if a != last or j != last_j:
                last, last_j = a, j
                _corners(labels, factors, i, j, a, corner, total, has)
                for channel in range(3):
                    west = corner[0, 0, channel] + fy * (corner[1, 0, channel] - corner[0, 0, channel])
                    east = corner[0, 1, channel] + fy * (corner[1, 1, channel] - corner[0, 1, channel])
                    left[channel], rise[channel] = west, east - west
            fx = np.float32(x - j)
            for channel in range(3):
                value = np.float32(rgba[r, c, channel]) * (left[channel] + fx * rise[channel]) + half
                rgba[r, c, channel] = np.uint8(min(value, np.float32(255.0)))


@in_place_kernel
def _corners(labels, factors, i, j, wanted, corner, total, has):  # type: ignore[no-untyped-def]
    """A picture's factors in four cells; where it has none, the mean of those that it has."""
    found = 0
    total[:] = 0.0
    has[:] = False
    for p in range(2):
        for q in range(2):
            for k in range(SLOTS):
                if labels[i + p, j + q, k] == wanted:
                    has[p, q] = True
                    found += 1
                    for channel in range(3):
                        corner[p, q, channel] = factors[i + p, j + q, k, channel]
                        total[channel] += corner[p, q, channel]
                    break
    for p in range(2):
        for q in range(2):
            if not has[p, q]:
                for channel in range(3):
                    corner[p, q, channel] = total[channel] / found if found else 1.0


@in_place_kernel
def laplacian(first, second, weight, anchor, x, out):  # type: ignore[no-untyped-def]
    """The normal matrix of differences and anchors times x, float64 (M, 3)."""
    for m in range(len(x)):
        for channel in range(3):
            out[m, channel] = anchor[m] * x[m, channel]
    for e in range(len(first)):
        i, j, w = first[e], second[e], weight[e]
        for channel in range(3):
            d = w * (x[i, channel] - x[j, channel])
            out[i, channel] += d
            out[j, channel] -= d

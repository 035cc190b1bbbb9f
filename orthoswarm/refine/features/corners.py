"""Compiled choice of corners: the strongest of each cell that holds none, by the minimum-eigenvalue measure.

Shi and Tomasi 1994, with Sobel gradients and a square window as in OpenCV's cornerMinEigenVal; only wanted cells are
computed, in whole numbers that float32 holds exactly.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel


@kernel
def strongest(gray, empty, size, top, left, window, border, floor, uv):  # type: ignore[no-untyped-def]
    """The strongest corner of each wanted cell, into uv float32 (K, 2), column and row; returns how many.

    Args:
        gray: uint8 (rows, columns). empty: bool, which cells are wanted. size: of a cell; top, left: of the first one.
        window: side of the square, odd. border: corners nearer to the picture's border are none.
        floor: least measure; cells without texture give no corner.
    """
    cells, cols = empty.shape[1], gray.shape[1]
    best, where, score = np.empty(cells, np.float32), np.empty((cells, 2), np.int64), np.empty(cols, np.float32)
    sums = np.zeros((window + 3, 3, cols), np.float32)
    return _search(gray, empty, size, top, left, window, border, floor, uv, best, where, score, sums)


@in_place_kernel
def _search(  # type: ignore[no-untyped-def]
    gray, empty, size, top, left, window, border, floor, uv, best, where, score, sums,
):  # fmt: skip
    """What `strongest` does.

    Args:
        best, where: (cells of a row,), (.., 2) room for the highest measure of each cell, and its pixel.
        score: float32 (columns,) room for the measures of a row.
        sums: float32 (window + 3, 3, columns) room for the products of as many rows, their total, those of a new row,
            and their sums over columns.
    """
    rows, cols = gray.shape
    reach = window // 2
    margin = max(border, reach + 1)
    scale = 1.0 / (4.0 * window * 255.0) ** 2
    found = 0
    lines, total, product, across = sums[:window], sums[window], sums[window + 1], sums[window + 2]
    for row in range(empty.shape[0]):
        y0, y1 = max(top + row * size, margin), min(top + (row + 1) * size, rows - margin)
        first = 0
        while first < empty.shape[1]:
            if not empty[row, first]:
                first += 1
                continue
            last = first
            while last < empty.shape[1] and empty[row, last]:
                last += 1
            x0, x1 = max(left + first * size, margin), min(left + last * size, cols - margin)
            best[first:last] = -1.0
            if x1 > x0 and y1 > y0:
                n = x1 - x0 + 2 * reach
                lines[:] = 0.0
                total[:] = 0.0
                for y in range(y0 - reach, y1 + reach):
                    _products(gray, y, x0 - reach, n, product)
                    old = lines[(y - y0 + reach) % window]
                    for k in range(3):
                        _exchange(product[k, :n], old[k, :n], total[k, :n])
                    if y >= y0 + reach:
                        _measure(total, x1 - x0, window, across, score)
                        _highest(score, x1 - x0, x0, y - reach, left, size, best, where)
            for cell in range(first, last):
                if best[cell] * scale > floor:
                    uv[found, 0], uv[found, 1] = where[cell, 0], where[cell, 1]
                    found += 1
            first = last
    return found


@in_place_kernel
def _products(gray, y, x, n, product):  # type: ignore[no-untyped-def]
    """Products of the Sobel gradients (xx, xy, yy) of n pixels of a row from a column on; slices vectorise."""
    nw, north, ne = gray[y - 1, x - 1 : x - 1 + n], gray[y - 1, x : x + n], gray[y - 1, x + 1 : x + 1 + n]
    west, east = gray[y, x - 1 : x - 1 + n], gray[y, x + 1 : x + 1 + n]
    sw, south, se = gray[y + 1, x - 1 : x - 1 + n], gray[y + 1, x : x + n], gray[y + 1, x + 1 : x + 1 + n]
    xx, xy, yy = product[0, :n], product[1, :n], product[2, :n]
    two = np.float32(2.0)
    for c in range(n):
        a, b, d, e = np.float32(nw[c]), np.float32(ne[c]), np.float32(sw[c]), np.float32(se[c])
        gx = b - a + e - d + two * (np.float32(east[c]) - np.float32(west[c]))
        gy = d - a + e - b + two * (np.float32(south[c]) - np.float32(north[c]))
        xx[c], xy[c], yy[c] = gx * gx, gx * gy, gy * gy


@in_place_kernel
def _exchange(new, old, total):  # type: ignore[no-untyped-def]
    """Take an old row from the total, add a new one, and keep it in the old one's place."""
    for c in range(len(total)):
        total[c] += new[c] - old[c]
        old[c] = new[c]


@in_place_kernel
def _measure(total, n, window, across, score):  # type: ignore[no-untyped-def]
    """Smaller eigenvalue of the gradient matrix about n pixels, whose sums over rows are known for each column."""
    xx, xy, yy = across[0, :n], across[1, :n], across[2, :n]
    xx[:] = 0.0
    xy[:] = 0.0
    yy[:] = 0.0
    for k in range(window):
        a, b, d = total[0, k : k + n], total[1, k : k + n], total[2, k : k + n]
        for c in range(n):
            xx[c] += a[c]
            xy[c] += b[c]
            yy[c] += d[c]
    half, to = np.float32(0.5), score[:n]
    for c in range(n):
        difference = half * (xx[c] - yy[c])
        to[c] = half * (xx[c] + yy[c]) - np.sqrt(difference * difference + xy[c] * xy[c])


@in_place_kernel
def _highest(score, n, x, y, left, size, best, where):  # type: ignore[no-untyped-def]
    """Compare the scores of a row with the best of their cells so far."""
    c = 0
    while c < n:
        cell = (x + c - left) // size
        end = min(n, left + (cell + 1) * size - x)
        top = best[cell]
        for k in range(c, end):
            if score[k] > top:
                top = score[k]
                where[cell, 0], where[cell, 1] = x + k, y
        best[cell] = top
        c = end

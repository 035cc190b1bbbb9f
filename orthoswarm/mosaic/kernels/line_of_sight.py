"""What stands over a line of sight, on a grid of heights."""

from typing import Final

from orthoswarm.compute.jit import in_place_kernel

HIDES_M: Final = 0.5  # what rises above a line of sight by less hides nothing: the noise of measured heights


@in_place_kernel
def first_over(heights, row, column, down, right, line, rise, top, skipped):  # type: ignore[no-untyped-def]
    """The first node over a line of sight, its number row by row; -1 where none is, as far as the grid goes.

    Args:
        heights: float32 (rows, columns). row, column: where the line begins, float64.
        down, right: rows and columns of a step along it, towards the camera; together they are 1 long.
        line: height at which it begins. rise: of a step. top: the greatest of the heights: above it nothing is.
        skipped: steps from the beginning on in which nothing counts.
    """
    n = skipped
    line += skipped * rise
    while line < top:
        n += 1
        line += rise
        i, j = int(row + n * down + 0.5), int(column + n * right + 0.5)
        if i < 0 or j < 0 or i >= heights.shape[0] or j >= heights.shape[1]:
            return -1
        if heights[i, j] > line:
            return i * heights.shape[1] + j
    return -1

"""The states of cells as a picture for the web map."""

import io
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.coverage.coverage_files import COLOURS
from orthoswarm.coverage.coverage_grid import State
from orthoswarm.model.geo import GroundGrid, LocalGrid

_LARGEST_PX: Final = 2048
_SHOWN_FIRST: Final = (State.MISSED, State.POOR, State.PLANNED, State.SEEN, State.EXCLUDED)


def cells_png(states: NDArray[np.uint8]) -> bytes:
    """A PNG with a palette, uint8 (rows, columns) of State; large areas are reduced without losing gaps."""
    from PIL import Image

    step = -(-max(states.shape) // _LARGEST_PX)
    if step > 1:
        rows, columns = (-(-side // step) * step for side in states.shape)
        padded = np.zeros((rows, columns), np.uint8)
        padded[: states.shape[0], : states.shape[1]] = states
        blocks = padded.reshape(rows // step, step, columns // step, step)
        states = np.zeros((rows // step, columns // step), np.uint8)
        for state in reversed(_SHOWN_FIRST):
            states[(blocks == state).any((1, 3))] = state
    picture = Image.fromarray(states, "P")
    table = [COLOURS[state] for state in State]
    picture.putpalette([value for red, green, blue, _ in table for value in (red, green, blue)])
    out = io.BytesIO()
    picture.save(out, "PNG", transparency=bytes(alpha for *_, alpha in table))
    return out.getvalue()


def picture_corners(grid: GroundGrid, states: NDArray[np.uint8]) -> list[list[float]]:
    """Longitude and latitude of the picture's corners: top left, top right, bottom right, bottom left."""
    step = -(-max(states.shape) // _LARGEST_PX)
    rows, columns = (-(-side // step) * step * grid.gsd_m for side in states.shape)
    east, south = grid.west + columns, grid.north - rows
    corners = [[grid.west, grid.north], [east, grid.north], [east, south], [grid.west, south]]
    return [[round(float(lon), 8), round(float(lat), 8)] for lat, lon in LocalGrid(grid.epsg).to_geographic(corners)]

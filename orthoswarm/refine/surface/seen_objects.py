"""What stands on the ground is drawn on its top only where the ground that it hides is seen past it.

Drawn on its top a roof stands where it stands, and the ground behind it comes from a picture that looks at it from
another side. Where no picture does, as beyond the outermost legs, that ground would have to be invented: the picture
would show the roof there once more. Drawn on the ground the same roof leans, and every pixel is drawn once.
"""

from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Flags, Ints
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.kernels.line_of_sight import HIDES_M, first_over
from orthoswarm.refine.bundle.block_arrays import CameraBlock, project_point

_MOST_HIDDEN_SHARE: Final = 0.02
"""An object may hide so much of its own area from all pictures: of a suburb 0.01 % is drawn twice, with 0.05 0.3 %."""
_MOST_TAN: Final = 2.0  # tangent of the view angle of pictures that are looked at: 63 degrees
_BLOCK_NODES: Final = 32  # nodes a side that are looked at with the pictures in one order


def seen_objects(terrain: Terrain, cameras: CameraBlock) -> Terrain:
    """The surface with those objects put on the ground that hide too much of it from all pictures.

    An object is what is raised and connected. It is put down as a whole, so that it is drawn in one piece.

    terrain: with `bare`. cameras: all that may be drawn, in the terrain's frame.
    """
    assert terrain.bare is not None
    z, over = terrain.z, terrain.z - terrain.bare
    reach = int(_MOST_TAN * float(over.max()) / terrain.step_m)
    doubtful = cv2.dilate((over > 0).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
    while (raised := z > terrain.bare).any():
        _, objects = cv2.connectedComponents(raised.astype(np.uint8), ltype=cv2.CV_32S)
        by = hidden_by(replace(terrain, z=z), cameras, doubtful)
        hidden = np.bincount(objects.ravel()[by[by >= 0]], minlength=objects.max() + 1)
        dropped = hidden > _MOST_HIDDEN_SHARE * np.bincount(objects.ravel())
        dropped[0] = False  # the ground itself
        if not dropped.any():
            break
        z = np.where(dropped[objects], terrain.bare, z)
        doubtful = (by >= 0) | dropped[objects]  # what was seen before is seen past less, too
    return replace(terrain, z=z)


def hidden_by(terrain: Terrain, cameras: CameraBlock, wanted: Flags) -> Ints:
    """The node that hides each node which no picture sees, int32 (rows, columns), -1 where a picture sees it.

    Of the pictures that would show it that one counts which is most nearly above. wanted: bool (rows, columns), -1
    elsewhere.
    """
    rows, columns = terrain.z.shape
    found = np.full(terrain.z.shape, -1, np.int32)
    top, reach = float(terrain.z.max()), _MOST_TAN * (cameras.position[:, 2] - terrain.z.min())
    for row in range(0, rows, _BLOCK_NODES):
        for column in range(0, columns, _BLOCK_NODES):
            if not wanted[row : row + _BLOCK_NODES, column : column + _BLOCK_NODES].any():
                continue
            part = np.array([row, min(row + _BLOCK_NODES, rows), column, min(column + _BLOCK_NODES, columns)])
            middle = np.array([terrain.west, terrain.south]) + terrain.step_m * (part[[2, 0]] + part[[3, 1]]) / 2
            away = np.hypot(*(cameras.position[:, :2] - middle).T) - _BLOCK_NODES * terrain.step_m
            near = np.flatnonzero(away < reach)
            order = near[np.argsort(away[near], kind="stable")]
            _look(
                terrain.z, terrain.west, terrain.south, terrain.step_m, part, order, *cameras.arrays,
                top, _MOST_TAN, HIDES_M, wanted, found,
            )  # fmt: skip
    return found


@in_place_kernel
def _look(z, west, south, step, part, order, position, rotation, lens_id, lens, top, most_tan, above, wanted, found):  # type: ignore[no-untyped-def]
    """Set `found` for the nodes of a part (rows from, to, columns from, to); see hidden_by."""
    for r in range(part[0], part[1]):
        for c in range(part[2], part[3]):
            if not wanted[r, c]:
                continue
            x, y, h = west + c * step, south + r * step, np.float64(z[r, c])
            least, by = np.inf, -1
            for k in order:
                dx, dy, rise = position[k, 0] - x, position[k, 1] - y, position[k, 2] - h
                away = max(np.hypot(dx, dy), 1e-6)
                if away > most_tan * rise:
                    continue
                row = lens[lens_id[k]]
                u, v = project_point(position[k], rotation[k], row, x, y, h)
                if not (u >= 0.0 and v >= 0.0 and u <= row[6] - 1.0 and v <= row[7] - 1.0):
                    continue
                step_rise = rise / away * step
                hides = first_over(z, np.float64(r), np.float64(c), dy / away, dx / away, h + above, step_rise, top, 0)
                if hides < 0:
                    by = -1
                    break
                if away < least * rise:
                    least, by = away / rise, hides
            found[r, c] = by

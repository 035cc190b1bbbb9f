"""How far the orthoimage lies from the map, block by block, as a user would see it by flickering the two."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.evaluation import FieldSettings, displacement_field
from orthoswarm.geo import GroundGrid

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_BLOCK_PX, _SEARCH_PX, _APART_PX = 64, 15, 6
_MOST_BLOCKS = 500


@dataclass(frozen=True, slots=True)
class Moved:
    """Where blocks of the map are found in the orthoimage.

    Attributes:
        at: float64 (K, 2), places in the orthoimage, on the ground.
        shift: float64 (K, 2), from there to the same thing in the map, metres.
        blocks: how many blocks were tried.
    """

    at: Array
    shift: Array
    blocks: int

    @classmethod
    def joined(cls, parts: "Sequence[Moved]") -> "Moved":
        """What several parts of the map show, together."""
        at, shift = ([np.zeros((0, 2)), *(getattr(p, name) for p in parts)] for name in ("at", "shift"))
        return cls(np.concatenate(at), np.concatenate(shift), sum(p.blocks for p in parts))

    @property
    def size_m(self) -> Array:
        """Lengths of the shifts, metres."""
        return np.asarray(np.hypot(self.shift[:, 0], self.shift[:, 1]))


def moved(ortho: Bytes, seen: Mask, basemap: Bytes, valid: Mask, grid: GroundGrid) -> Moved:
    """Match a map to an orthoimage of the same grid, at up to some hundred places.

    Only clear matches count. What changed between the two (debris, other seasons) therefore gives no arrow, rather
    than a wrong one.

    Args:
        ortho: grey orthoimage (rows, columns).
        seen: where it is drawn.
        basemap: grey map on the same grid.
        valid: where the map means something.
        grid: of both.
    """
    step = max(_BLOCK_PX, float(np.sqrt(seen.sum() / _MOST_BLOCKS)))
    settings = FieldSettings(
        gsd_m=grid.gsd_m,
        block_m=_BLOCK_PX * grid.gsd_m,
        step_m=step * grid.gsd_m,
        search_m=_SEARCH_PX * grid.gsd_m,
        apart_m=_APART_PX * grid.gsd_m,
        min_cover=0.9,
        min_peak=0.4,  # a map of another day: a chance likeness reaches 0.3
    )
    field = displacement_field(ortho.astype(np.float32), seen, basemap.astype(np.float32), valid, settings)
    found = field.matched
    shift = field.shift_m[found]
    return Moved(grid.to_ground(field.position[found]) + shift, -shift, len(found))

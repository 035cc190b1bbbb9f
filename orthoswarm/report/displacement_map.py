"""How far the orthoimage lies from the map, block by block, as a user would see it by flickering the two."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.evaluation.displacement import Displacements, FieldSettings, displacement_field
from orthoswarm.model.geo import GroundGrid

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_BLOCK_PX: Final = 64  # side of a block
_SEARCH_PX: Final = 15  # how far it is searched
_APART_PX: Final = 6  # correlations within this distance, pixels, belong to the same peak
_MOST_BLOCKS: Final = 500  # most blocks of a map (for its time)
_LEAST_COVER: Final = 0.9  # least share of a block and of its search area that is drawn
_LEAST_PEAK: Final = 0.4  # least correlation: chance likeness reaches 0.3 (measured on simulated disasters)
_BAND_PX: Final = 500_000  # pixels that are compared at once (memory: gradients take a hundred bytes a pixel)


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
        min_cover=_LEAST_COVER,
        min_peak=_LEAST_PEAK,
    )
    field = Displacements.joined(list(_fields(ortho, seen, basemap, valid, settings)))
    found = field.matched
    shift = field.shift_m[found]
    return Moved(grid.to_ground(field.position[found]) + shift, -shift, len(found))


def _fields(ortho: Bytes, seen: Mask, basemap: Bytes, valid: Mask, settings: FieldSettings) -> Iterator[Displacements]:
    """The field in bands of whole rows of blocks: gradients take a hundred bytes a pixel."""
    side, step, reach = (
        max(1, round(length / settings.gsd_m)) for length in (settings.block_m, settings.step_m, settings.search_m)
    )
    wide_ortho, wide_seen = np.pad(ortho, reach), np.pad(seen, reach)
    rows, columns = basemap.shape
    at_once = step * max(1, _BAND_PX // columns // step)
    for top in range(0, rows - side + 1, at_once):
        last = min(top + at_once, rows - side + 1) - 1
        end = last // step * step + side
        around = slice(top, end + 2 * reach)
        yield displacement_field(
            wide_ortho[around].astype(np.float32), wide_seen[around], basemap[top:end].astype(np.float32),
            valid[top:end], settings=settings, offset=(top, 0),
        )  # fmt: skip

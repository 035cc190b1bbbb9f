"""How far the orthoimage lies from the map, block by block, as a user would see it by flickering the two."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.evaluation.displacement import Displacements, FieldSettings, displacement_field
from orthoswarm.model.geo import GroundGrid

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]


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
    config = active().evaluation
    step = max(config.block_px, float(np.sqrt(seen.sum() / config.most_blocks)))
    settings = FieldSettings(
        gsd_m=grid.gsd_m,
        block_m=config.block_px * grid.gsd_m,
        step_m=step * grid.gsd_m,
        search_m=config.search_px * grid.gsd_m,
        apart_m=config.apart_px * grid.gsd_m,
        min_cover=config.least_cover,
        min_peak=config.least_peak,
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
    at_once = step * max(1, active().evaluation.band_px // columns // step)
    for top in range(0, rows - side + 1, at_once):
        last = min(top + at_once, rows - side + 1) - 1
        end = last // step * step + side
        around = slice(top, end + 2 * reach)
        yield displacement_field(
            wide_ortho[around].astype(np.float32), wide_seen[around], basemap[top:end].astype(np.float32),
            valid[top:end], settings=settings, offset=(top, 0),
        )  # fmt: skip

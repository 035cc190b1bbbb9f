"""An adjustment as it was, to go back to where steps lead astray."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import CameraBlock, Tracks
from orthoswarm.refine.bundle.priors import Priors

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What steps change in an adjustment (see Adjustment for the attributes); its order is found again when needed."""

    cameras: CameraBlock
    tracks: Tracks
    priors: Priors
    points: Array
    free: NDArray[np.bool_]
    common: Array
    obs_weight: Array
    point_inverse: Array

    @classmethod
    def of(cls, adj: Adjustment) -> "Snapshot":
        """An adjustment as it is."""
        cameras = replace(
            adj.cameras,
            position=adj.cameras.position.copy(),
            rotation=adj.cameras.rotation.copy(),
            lens=adj.cameras.lens.copy(),
        )
        return cls(
            cameras, adj.tracks, adj.priors, adj.points.copy(), adj.free, adj.common.copy(), adj.obs_weight.copy(),
            adj.point_inverse.copy(),
        )  # fmt: skip

    def restored(self) -> Adjustment:
        """The adjustment as it was; the snapshot stays as it is."""
        out = Adjustment.begin(self.cameras, self.tracks, self.priors, self.points, self.free)
        out.common[:] = self.common
        out.obs_weight[:] = self.obs_weight
        out.point_inverse[:] = self.point_inverse
        return out

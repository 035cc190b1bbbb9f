"""What the daemon keeps of a placed sortie beside its journal: a pickle of the solution and what drawing it needs."""

import os
import pickle
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.atomic_file import written_whole
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.placement import PlacedFrame, Solution, Terrain
from orthoswarm.mosaic.footprint import footprint_boxes
from orthoswarm.mosaic.radiometry import estimate_fields

Bytes = NDArray[np.uint8]
Gain = NDArray[np.float32]

_OVERLAP_M: Final = 50.0
_THUMBNAIL: Final = (12, 16, 3)
OWN, OTHER = "own", "other"


@dataclass(frozen=True, slots=True)
class Kept:
    """A placed sortie.

    Attributes:
        solution: its frames' cameras.
        thumbnails: image -> uint8 (12, 16, 3). gains: image -> float32 (3,), as it was drawn.
    """

    solution: Solution
    thumbnails: dict[str, Bytes] = field(default_factory=dict)
    gains: dict[str, Gain] = field(default_factory=dict)

    @property
    def terrain(self) -> Terrain:
        """The ground under its frames."""
        return self.solution.terrain or Terrain.flat(self.solution.ground_z_m)

    def write(self, path: Path) -> None:
        """Write it, whole and synced or not at all.

        Raises:
            OrthoSwarmError: the disk is full.
        """
        with written_whole(path) as part, part.open("wb") as file:
            pickle.dump(self, file, pickle.HIGHEST_PROTOCOL)
            file.flush()
            os.fsync(file.fileno())


def load_kept(path: Path) -> Kept:
    """What `Kept.write` wrote; also a bare solution, as earlier versions did."""
    found = pickle.loads(path.read_bytes())
    return found if isinstance(found, Kept) else Kept(found)


def thumbnail_of(data: bytes) -> Bytes:
    """A thumbnail as the journal keeps it."""
    return np.frombuffer(data, np.uint8).reshape(_THUMBNAIL)


def seen(placed: list[PlacedFrame], terrain: Terrain) -> BoundingBox:
    """The ground that frames see."""
    boxes = footprint_boxes([p.camera for p in placed], float(terrain.z.min()), float(terrain.z.max()))
    boxes = boxes[np.isfinite(boxes).all(1)]
    return BoundingBox.around(boxes) if len(boxes) else BoundingBox(0.0, 0.0, 0.0, 0.0)


def touches(placed: PlacedFrame, bounds: BoundingBox) -> bool:
    """Whether a frame may see ground within bounds; generous."""
    reach = 3.0 * float(placed.camera.position[2]) + _OVERLAP_M
    x, y = (float(v) for v in placed.camera.position[:2])
    west, south, east, north = bounds
    return west - reach < x < east + reach and south - reach < y < north + reach


def marked(placed: PlacedFrame, number: int, *, own: bool) -> PlacedFrame:
    """A frame under a name of its own: vehicles may use the same names, the renderer tells frames apart by them."""
    frame = placed.frame
    return replace(placed, frame=replace(frame, image=f"{number} {OWN if own else OTHER} {frame.image}"))


def gains_of(
    solution: Solution, thumbnails: Mapping[str, Bytes], others: Iterable[Kept], held: Mapping[str, Gain] | None = None
) -> dict[str, Gain]:
    """Gains of a solution's frames, even with each other and with those of others that are drawn already.

    Args:
        solution: whose frames. thumbnails: image -> uint8 (12, 16, 3) of those that were read.
        others: sorties nearby; they stay as they are. held: image -> gain of own frames that stay, too.
    """
    terrain = solution.terrain or Terrain.flat(solution.ground_z_m)
    bounds = seen(solution.placed, terrain)
    frames: list[PlacedFrame] = []
    small: dict[str, Bytes] = {}
    fixed: dict[str, Gain] = {}
    names: dict[str, str] = {}

    def put(placed: PlacedFrame, own: bool, pictures: Mapping[str, Bytes], gains: Mapping[str, Gain]) -> None:
        image = placed.frame.image
        frame = marked(placed, len(frames), own=own)
        frames.append(frame)
        name = frame.frame.image
        if own:
            names[name] = image
        if image in pictures:
            small[name] = pictures[image]
        if image in gains:
            fixed[name] = gains[image]

    for placed in solution.placed:
        put(placed, True, thumbnails, held or {})
    for other in others:
        for placed in other.solution.placed:
            if placed.frame.image in other.gains and touches(placed, bounds):
                put(placed, False, other.thumbnails, other.gains)
    found = estimate_fields(frames, small, terrain, fixed)
    return {names[name]: gain for name, gain in found.items() if name in names}

"""Solution files: a placed sortie with the data for drawing it, pickled next to the journal."""

import hashlib
import os
import pickle
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera, Lens
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.placement import Leg, PlacedFrame, Solution, Terrain
from orthoswarm.mosaic.footprint import footprint_boxes
from orthoswarm.mosaic.radiometry import estimate_fields

Bytes = NDArray[np.uint8]
Gain = NDArray[np.float32]

_FORMAT: Final = 2
"""To be raised when the refiner's own part of a solution (`Solution.state`) changes."""
_OVERLAP_M: Final = 50.0
_THUMBNAIL: Final = (12, 16, 3)
OWN, OTHER = "own", "other"


class SolutionFileError(OrthoSwarmError):
    """A solution file is damaged, or of another version of the program."""


@dataclass(frozen=True, slots=True)
class SolutionFile:
    """A placed sortie with the data for drawing it, as stored in a solution file.

    Attributes:
        solution: its frames' cameras.
        thumbnails: image -> uint8 (12, 16, 3). gains: image -> float32 (3, 6), see `Field`, as it was drawn.
    """

    solution: Solution
    thumbnails: dict[str, Bytes] = field(default_factory=dict)
    gains: dict[str, Gain] = field(default_factory=dict)

    @property
    def terrain(self) -> Terrain:
        """The ground under its frames."""
        return self.solution.terrain or Terrain.flat(self.solution.ground_z_m)

    def write(self, path: Path) -> None:
        """Write it completely and synced, or not at all; raises StorageError: the disk is full."""
        with atomic_write(path) as part, part.open("wb") as file:
            file.write(_header())
            pickle.dump(self, file, pickle.HIGHEST_PROTOCOL)
            file.flush()
            os.fsync(file.fileno())


def is_readable(path: Path) -> bool:
    """Whether a solution file was written by this version of the program, by its first bytes."""
    try:
        with path.open("rb") as file:
            return file.read(len(_header())) == _header()
    except OSError:
        return False


def read_solution(path: Path) -> SolutionFile:
    """What `SolutionFile.write` wrote.

    Raises:
        SolutionFileError: the file is gone, damaged, or of another version of the program.
    """
    reason = f"{path.name} was written by another version of the program; refine its vehicle again"
    if not is_readable(path):
        raise SolutionFileError(reason if path.exists() else f"{path.name} is gone; refine its vehicle again")
    try:
        with path.open("rb") as file:
            file.seek(len(_header()))
            found = pickle.load(file)
    except Exception:  # a damaged pickle, or one whose classes have moved, can raise anything
        raise SolutionFileError(f"{path.name} is damaged; refine its vehicle again") from None
    if not isinstance(found, SolutionFile):
        raise SolutionFileError(reason)
    return found


@cache
def _header() -> bytes:
    """Begins each file: the format's number, and a digest of the names and fields that the pickle relies on."""
    classes = (SolutionFile, Solution, PlacedFrame, Leg, Terrain, Camera, Lens, Frame, Fix)
    names = [(c.__module__, c.__qualname__, [f.name for f in fields(c)]) for c in classes]
    return f"OrthoSwarm solution {_FORMAT} {hashlib.sha256(repr(names).encode()).hexdigest()[:16]}\n".encode()


def thumbnail_of(data: bytes) -> Bytes:
    """A thumbnail as stored in the journal."""
    return np.frombuffer(data, np.uint8).reshape(_THUMBNAIL)


def visible_ground(placed: list[PlacedFrame], terrain: Terrain) -> BoundingBox:
    """The ground that frames see."""
    boxes = footprint_boxes([p.camera for p in placed], float(terrain.z.min()), float(terrain.z.max()))
    boxes = boxes[np.isfinite(boxes).all(1)]
    return BoundingBox.around(boxes) if len(boxes) else BoundingBox(0.0, 0.0, 0.0, 0.0)


def may_see(placed: PlacedFrame, bounds: BoundingBox) -> bool:
    """Whether a frame may see ground within bounds; generous."""
    reach = 3.0 * float(placed.camera.position[2]) + _OVERLAP_M
    x, y = (float(v) for v in placed.camera.position[:2])
    west, south, east, north = bounds
    return west - reach < x < east + reach and south - reach < y < north + reach


def uniquely_named(placed: PlacedFrame, number: int, *, own: bool) -> PlacedFrame:
    """A frame under a unique name: vehicles may use the same names, and the renderer distinguishes frames by name."""
    frame = placed.frame
    return replace(placed, frame=replace(frame, image=f"{number} {OWN if own else OTHER} {frame.image}"))


def gains_of(
    solution: Solution,
    thumbnails: Mapping[str, Bytes],
    others: Iterable[SolutionFile],
    held: Mapping[str, Gain] | None = None,
) -> dict[str, Gain]:
    """Gains of a solution's frames, balanced among each other and with drawn frames of others.

    Args:
        solution: whose frames. thumbnails: image -> uint8 (12, 16, 3) of those that were read.
        others: sorties nearby, unchanged. held: image -> gain of own frames that are unchanged, too.
    """
    terrain = solution.terrain or Terrain.flat(solution.ground_z_m)
    bounds = visible_ground(solution.placed, terrain)
    frames: list[PlacedFrame] = []
    small: dict[str, Bytes] = {}
    fixed: dict[str, Gain] = {}
    names: dict[str, str] = {}

    def put(placed: PlacedFrame, own: bool, pictures: Mapping[str, Bytes], gains: Mapping[str, Gain]) -> None:
        image = placed.frame.image
        frame = uniquely_named(placed, len(frames), own=own)
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
            if placed.frame.image in other.gains and may_see(placed, bounds):
                put(placed, False, other.thumbnails, other.gains)
    found = estimate_fields(frames, small, terrain, fixed)
    return {names[name]: gain for name, gain in found.items() if name in names}

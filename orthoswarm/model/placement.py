"""Placed frames and what belongs to them: the refiner's result and the renderer's input."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera
from orthoswarm.model.frame import Frame
from orthoswarm.model.task_runner import Run, serial

Array = NDArray[np.float64]
Stage = Literal["realtime", "coarse", "fine"]
LegState = Literal["matched", "carried", "failed"]
STATED_SIGMA_FACTOR: Final = 1.25
"""The stated sigma is this times the sigma of an axis, to stand between both meanings of "the error" of a point on the
ground: of Gaussian errors 79 and 98.8 % of each axis lie within one and two of it, and 54 and 95.6 % of their
lengths."""


@dataclass(frozen=True, slots=True)
class PlacedFrame:
    """A frame with its camera in the area's grid.

    Attributes:
        frame: the picture. camera: position (east, north, height over the common datum), orientation and lens.
        stage: how far it was refined.
        sigma_m: own estimate of the ground error at the picture's central pixel, one sigma per axis, metres.
        weak: True where too few observations hold it; it is placed but left out of the mosaic while others cover.
        pose_covariance: float32 (6, 6) of position (east, north, up, metres) and rotation about the camera's axes
            (radians) in the adjustment, without errors common to all frames; None where it is not known.
    """

    frame: Frame
    camera: Camera
    stage: Stage
    sigma_m: float
    weak: bool = False
    _: KW_ONLY
    pose_covariance: NDArray[np.float32] | None = field(default=None, compare=False)

    def reduced(self, factor: int) -> "PlacedFrame":
        """The same with its picture averaged over blocks of factor x factor pixels."""
        return (
            self if factor == 1 else replace(self, camera=replace(self.camera, lens=self.camera.lens.reduced(factor)))
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """A straight run of one vehicle's frames, and how well the map held it.

    Attributes:
        vehicle: id.
        first, last: indices of its first and last frame among the vehicle's solved frames, lens after lens.
        images: names of both.
        state: matched to the map by evidence of its own; carried by legs that were, of its vehicle or of neighbours;
            failed: it lies where the receiver says.
        confidence: 0 to 1. sigma_m: own error estimate in metres.
    """

    vehicle: str
    first: int
    last: int
    images: tuple[str, str]
    state: LegState = "failed"
    confidence: float = 0.0
    sigma_m: float = float("nan")

    @classmethod
    def of(
        cls,
        frames: Sequence[Frame],
        members: NDArray[np.integer],
        state: LegState = "failed",
        confidence: float = 0.0,
        sigma_m: float = float("nan"),
    ) -> "Leg":
        """The leg of a vehicle's frames with these ascending indices."""
        first, last = int(members[0]), int(members[-1])
        return cls(
            vehicle=frames[first].vehicle, first=first, last=last, images=(frames[first].image, frames[last].image),
            state=state, confidence=confidence, sigma_m=sigma_m,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Terrain:
    """Ground height on a regular grid of nodes, bilinear between them, constant beyond the border.

    Attributes:
        west, south: easting of node column 0 and northing of node row 0 (rows go north), metres.
        step_m: distance of nodes. z: float32 (rows, columns), metres over the datum of the cameras.
        bare: the same without tall surfaces (halls, woods); None where z has no such tops.
        tops: up to where something may stand: what was found, drawn on its top or not, and what may be there where the
            pictures did not decide; None where nothing stands.
    """

    west: float
    south: float
    step_m: float
    z: NDArray[np.float32]
    _: KW_ONLY
    bare: NDArray[np.float32] | None = None
    tops: NDArray[np.float32] | None = None

    @classmethod
    def flat(cls, z_m: float = 0.0) -> "Terrain":
        """A level plane."""
        return cls(0.0, 0.0, 1e6, np.full((2, 2), z_m, np.float32))

    def bare_ground(self) -> "Terrain":
        """The ground without the tops of what stands on it."""
        return self if self.bare is None else replace(self, z=self.bare, bare=None, tops=None)

    def changed(
        self,
        change: Callable[[NDArray[np.float32]], NDArray[np.float32]],
        west: float | None = None,
        south: float | None = None,
    ) -> "Terrain":
        """The ground with a change made to each of its grids of heights, whose first node then lies elsewhere."""
        bare, tops = (None if z is None else change(z) for z in (self.bare, self.tops))
        west, south = self.west if west is None else west, self.south if south is None else south
        return replace(self, west=west, south=south, z=change(self.z), bare=bare, tops=tops)

    def nodes(self) -> Array:
        """Positions (rows, columns, 2) of the nodes."""
        rows, columns = self.z.shape
        east, north = self.west + self.step_m * np.arange(columns), self.south + self.step_m * np.arange(rows)
        return np.stack(np.meshgrid(east, north), -1)

    def height(self, east_north: NDArray[Any]) -> Array:
        """Heights (...,) at ground points (..., 2)."""
        p = np.asarray(east_north, float)
        rows, cols = self.z.shape
        c = np.clip((p[..., 0] - self.west) / self.step_m, 0.0, cols - 1.000001)
        r = np.clip((p[..., 1] - self.south) / self.step_m, 0.0, rows - 1.000001)
        ci, ri = c.astype(np.intp), r.astype(np.intp)
        fc, fr = c - ci, r - ri
        z = self.z  # a float32 height times a float64 share is float64: the whole grid need not be converted
        low = z[ri, ci] * (1 - fc) + z[ri, ci + 1] * fc
        high = z[ri + 1, ci] * (1 - fc) + z[ri + 1, ci + 1] * fc
        return np.asarray(low * (1 - fr) + high * fr)


@dataclass(frozen=True, slots=True, kw_only=True)
class Solution:
    """What a refiner made of one vehicle.

    Attributes:
        vehicle: id. placed: its frames in order, those it could place. dropped: image -> reason for those it could not.
        legs: its legs. fov_deg, fov_sigma_deg: estimated horizontal field of view of its (main) camera, and its sigma.
        terrain: ground height under its frames (same datum as the cameras), None for flat at `ground_z_m`.
        ground_z_m: level of the ground that its vehicles map, the plane on which homographies are stated.
        map_lean: metres of shift per metre of height in the basemap, (east, north).
        state: what a second pass needs (refiner's own, picklable).
        warnings: findings in plain words (yaw flips, wrong altitude, lag...).
        timings: stage name -> CPU seconds, for the report.
        gsd_m: mean size of its pictures' pixels on the ground: height above the mean of the points that count as ground
            (rubble and hedges among them, so it is a little above the plane of the homographies) over the focal length.
            NaN where not known.
        false_matches: how many registrations as good as this one a map of other ground would give (expected number);
            NaN where the map did not register it.
    """

    vehicle: str
    placed: list[PlacedFrame]
    dropped: Mapping[str, str]
    legs: list[Leg]
    fov_deg: float
    fov_sigma_deg: float
    terrain: Terrain | None
    ground_z_m: float = 0.0
    map_lean: tuple[float, float] = (0.0, 0.0)
    state: Any = None
    warnings: list[str] = field(default_factory=list)
    timings: dict[str, float] = field(default_factory=dict)
    gsd_m: float = float("nan")
    false_matches: float = float("nan")


class MapWindow(Protocol):
    """The pre-disaster map as the core sees it: grey windows on any grid, read on demand (basemap.Basemap)."""

    epsg: int

    @property
    def bounds(self) -> BoundingBox:
        """West, south, east, north of the map in the area's grid."""

    @property
    def native_gsd_m(self) -> float:
        """Size of the map's own pixel."""

    def gray(self, bounds: BoundingBox, gsd_m: float) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Grey values (rows, columns), 0 to 255, and validity of a window; see GroundGrid.around for its frame."""


@dataclass(slots=True)
class Refinement:
    """What a refiner made of a batch.

    Attributes:
        coarse: one solution a vehicle before the map was used. fine: the same vehicles in the same order after it.
        terrain: ground under the fine cameras, None for flat. warnings: findings that concern all vehicles.
        equation_5: predicted and measured time by the paper's Eq. 5; empty where the refiner does not work by it.
    """

    coarse: list[Solution]
    fine: list[Solution]
    terrain: Terrain | None
    warnings: list[str] = field(default_factory=list)
    equation_5: Mapping[str, float] = field(default_factory=dict)


class Refiner(Protocol):
    """The seam of both refiners (swarm, paper): the unit is a vehicle, a batch is a loop over vehicles.

    The daemon calls `refine` when a vehicle completes and `again` when its neighbours have; the batch and the
    benchmarks call `refine_batch`, and do not know which refiner it is. What the daemon does in flight (tracks, coarse
    placement) only the default refiner offers.
    """

    def refine(
        self,
        frames: Sequence[Frame],
        neighbours: Sequence[Solution],
        basemap: MapWindow | None,
    ) -> Solution:
        """Place one vehicle's frames.

        Args:
            frames: in order of time, of one vehicle. neighbours: earlier solutions of this refiner, held as they are.
            basemap: the map on the area's grid; None to stay in the receivers' frame.

        Raises:
            OrthoSwarmError: if nothing can be made of the frames.
        """

    def again(self, solution: Solution, neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """Place a vehicle again beside neighbours that were solved since; the same solution where nothing changes."""

    def refined_frames(self, solution: Solution) -> list[Frame]:
        """The frames that this refiner solved; others of a solution were placed as recorded or by their neighbours.

        Args:
            solution: an earlier one of this refiner.
        """

    def refine_batch(
        self,
        vehicles: Mapping[str, Sequence[Frame]],
        basemap: MapWindow | None,
        run: Run = serial,
        progress: Callable[[str, int, int], None] | None = None,
        *,
        halo: Collection[str] = (),
    ) -> Refinement:
        """Place all vehicles, on one height level and one terrain.

        Args:
            vehicles: id -> frames in order of time. basemap: the map on the area's grid, or None.
            run: how tasks are run; the result does not depend on it.
            progress: called with what is being done, how many are done, how many there are.
            halo: vehicles that only hold their neighbours: they are solved as far as that needs, and no tall surfaces
                are measured for them.

        Raises:
            OrthoSwarmError: if there is nothing to refine.
        """

"""Ground points between tie points: the vertical line locus method with several pictures.

At a free position the picture nearest to nadir is the reference. Partners before and behind it on the same leg (where
it ends too early, pictures of other legs) are compared with it at every height. A patch of the reference is rectified
on the local plane of the terrain, and so is a strip of each partner along its epipolar line there, on which a change of
height is a shift. Pictures are read one after the other along the legs, with only a window of them in memory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Gray, Indices, Ints
from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import CameraBlock, F
from orthoswarm.refine.features.working_pictures import shrunk
from orthoswarm.refine.surface import vertical_line_kernels as kernels

ReadPicture = Callable[[int], Gray]

REFERENCE_HEIGHT_M: Final = 150.0  # flying height for which lengths of patches are stated
_SWEEP_REACH_M: Final = 9.0  # heights searched above and below the terrain
_SWEEP_HEIGHT_STEP_M: Final = 0.375  # distance of the heights searched at reference height
_SWEEP_BASELINES_M: Final = (50.0, 95.0)  # wished distances of partners on both sides, at reference height
_SWEEP_SPACING_M: Final = 17.0  # only pictures this far apart along a leg are used at reference height
_SWEEP_LEAST_BASELINE_SHARE: Final = 0.4  # least baseline as a share of the shortest that is wished
_SWEEP_RIVAL_M: Final = 4.0  # second peak farther than this from the best makes a height ambiguous at reference height
_SWEEP_RIVAL_SHARE: Final = 0.95  # ... if it is above this share of the best
_SWEEP_LEAST_VARIANCE: Final = 2.0  # least variance of a patch's grey values, squared: less is the noise of a JPEG
_SWEEP_STEEPEST: Final = 1.5  # steepest slope of a patch's plane: across a wall it is none
_SWEEP_SLOPE_REACH_M: Final = 5.0  # the slope below a patch is taken over this distance at least
_SWEEP_REFERENCES: Final = 16  # references whose pictures, and those of their partners, are held at a time (memory)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """Settings of the height search. Lengths in metres, for the reference height above ground; see `at_height`.

    Attributes:
        half: half width of the square patch in samples (7: 15 x 15 samples), step_m apart.
        reach_m: range searched above and below the terrain, in steps of height_step_m. min_score: least correlation.
        rival_m: a second peak farther than this from the best one, nearly as high, makes the height ambiguous;
            infinite switches the test off. sigma_m: one sigma of a height on open ground.
        baselines_m: desired distances of the partners, on both sides of the reference.
        spacing_m: only pictures this far apart along a leg are used, to limit decoding.
    """

    half: int
    step_m: float
    min_score: float
    sigma_m: float
    reach_m: float = _SWEEP_REACH_M
    height_step_m: float = _SWEEP_HEIGHT_STEP_M
    rival_m: float = _SWEEP_RIVAL_M
    baselines_m: tuple[float, ...] = _SWEEP_BASELINES_M
    spacing_m: float = _SWEEP_SPACING_M

    def at_height(self, height_m: float) -> "Sweep":
        """The same sweep for cameras at another height above ground: all lengths but the reach are scaled."""
        k = height_m / REFERENCE_HEIGHT_M
        lengths = ("step_m", "height_step_m", "sigma_m", "spacing_m", "rival_m")
        scaled = {name: getattr(self, name) * k for name in lengths}
        return replace(self, baselines_m=tuple(b * k for b in self.baselines_m), **scaled)

    @property
    def heights(self) -> Array:
        """The heights to test, relative to the terrain."""
        count = int(np.ceil(self.reach_m / self.height_step_m))
        return np.asarray(np.arange(-count, count + 1) * self.height_step_m, np.float64)


SMALL_PATCH: Final = Sweep(half=4, step_m=0.5, min_score=0.7, sigma_m=0.15)
"""It fits between cars, bushes and houses: on a street scene three quarters of its heights lie within 0.2 m of bare
ground, half of the large one's, most others above."""
LARGE_PATCH: Final = Sweep(half=7, step_m=0.7, min_score=0.6, sigma_m=0.25)  # heights where texture is weak


@dataclass(frozen=True, slots=True)
class LocusPoints:
    """Points found by a sweep.

    Attributes:
        points: float64 (M, 3), on the reference's ray through the position, so slightly off the position.
        sigma_z: float64 (M,), one sigma of each height. cell: int64 (M,), position that each belongs to, ascending.
    """

    points: Array
    sigma_z: Array
    cell: Indices


def dense_ground(
    cameras: CameraBlock,
    gray: ReadPicture,
    cells: Array,
    *,
    terrain: Terrain,
    leg_of_camera: NDArray[np.integer],
    sweeps: Sequence[Sweep] | None = None,
) -> LocusPoints:
    """Heights at free positions from correlation between pictures, preferably of one leg.

    Args:
        gray: picture of a camera by its index, uint8 (rows, columns) as its lens says; called in the order of the
            legs, for a picture twice at most unless it is a partner on another leg.
        cells: float64 (C, 2), positions, east and north.
        terrain: surface around which heights are searched; its slope tilts the patches.
        leg_of_camera: int (N,), leg of each camera, -1 for cameras that must not be used.
        sweeps: applied in order, each to the positions where those before found nothing. Baselines and spacing are the
            first one's. None: small patches, then large, for the cameras' height above the terrain.
    """
    if sweeps is None:
        height = height_above(cameras, terrain)
        sweeps = (SMALL_PATCH.at_height(height), LARGE_PATCH.at_height(height))
    s = sweeps[0]
    cells = np.ascontiguousarray(cells, dtype=np.float64).reshape(-1, 2)
    plane = _planes(terrain, cells, max(_SWEEP_SLOPE_REACH_M, s.half * s.step_m))
    camera, heading = spaced_cameras(cameras, leg_of_camera, s.spacing_m)
    wished = np.array([*s.baselines_m, *(-b for b in s.baselines_m)])
    ref, partner = np.full(len(cells), -1, np.int32), np.full((len(cells), len(wished)), -1, np.int32)
    least = _SWEEP_LEAST_BASELINE_SHARE * min(s.baselines_m)
    kernels.choose(cameras.arrays, camera, heading, cells, plane, s.half * s.step_m, wished, least, ref, partner)
    found = np.full((len(cells), 3), -1.0)
    gsd_m = height_above(cameras, terrain) / float(cameras.lens[:, F].max())
    factor = max(1, int(min(sweep.step_m for sweep in sweeps) / gsd_m))
    for first in range(0, len(camera), _SWEEP_REFERENCES):  # in the order of the legs
        left = np.flatnonzero(np.isin(ref, camera[first : first + _SWEEP_REFERENCES]))
        if len(left):
            held = np.unique([ref[left], *partner[left].T])
            held = held[held >= 0]
            _search(
                cameras,
                _stacked(cameras, gray, held, factor),
                cells,
                plane,
                ref=ref,
                partner=partner,
                sweeps=sweeps,
                left=left,
                found=found,
            )
    good = np.flatnonzero(found[:, 1] >= 0.0)
    points = np.empty((len(good), 3))
    kernels.raise_points(cameras.position, ref[good], cells[good], plane[good], found[good, 0], points)
    return LocusPoints(points, found[good, 2], good)


def height_above(cameras: CameraBlock, terrain: Terrain) -> float:
    """Median height of cameras above the terrain, metres, at least 1."""
    if len(cameras) == 0:
        return REFERENCE_HEIGHT_M
    return max(1.0, float(np.median(cameras.position[:, 2] - terrain.height(cameras.position[:, :2]))))


def spaced_cameras(cameras: CameraBlock, leg_of_camera: NDArray[np.integer], spacing_m: float) -> tuple[Ints, Array]:
    """Cameras spaced along their legs, and each leg's last one, in the order of the legs: int32 (K,).

    And the legs' directions, float64 (K, 2).
    """
    camera: list[int] = []
    heading: list[Array] = []
    for number in np.unique(leg_of_camera[leg_of_camera >= 0]):
        members = np.flatnonzero(leg_of_camera == number)
        if len(members) < 2:
            continue
        p = cameras.position[members, :2]
        direction = np.linalg.svd(p - p.mean(0), full_matrices=False)[2][0]
        way, last = (p - p.mean(0)) @ direction, -np.inf
        rank = np.argsort(way)
        for i in rank:
            if way[i] >= last + spacing_m or i == rank[-1]:
                camera.append(int(members[i]))
                heading.append(direction)
                last = way[i]
    return np.array(camera, np.int32), np.array(heading, np.float64).reshape(-1, 2)


def _planes(terrain: Terrain, cells: Array, reach: float) -> Array:
    """Height and slope (east, north) of the terrain at positions: float64 (C, 3)."""
    e, n = np.array([reach, 0.0]), np.array([0.0, reach])
    z = terrain.height(cells)
    ge = (terrain.height(cells + e) - terrain.height(cells - e)) / (2 * reach)
    gn = (terrain.height(cells + n) - terrain.height(cells - n)) / (2 * reach)
    return np.column_stack([z, np.clip(np.column_stack([ge, gn]), -_SWEEP_STEEPEST, _SWEEP_STEEPEST)])


def _stacked(
    cameras: CameraBlock, gray: ReadPicture, held: Indices, factor: int
) -> tuple[NDArray[np.uint8], Ints, float]:
    """Pictures as the kernel takes them: reduced ones in a stack, each camera's place in it, by how much."""
    pictures = [shrunk(gray(int(i)), factor) for i in held]
    stack = np.zeros((len(held), *np.max([p.shape for p in pictures], axis=0)), np.uint8)
    for place, picture in zip(stack, pictures, strict=True):
        place[: picture.shape[0], : picture.shape[1]] = picture
    slot = np.full(len(cameras), -1, np.int32)
    slot[held] = np.arange(len(held))
    return stack, slot, float(factor)


def _search(
    cameras: CameraBlock,
    pictures: tuple[NDArray[np.uint8], Ints, float],
    cells: Array,
    plane: Array,
    *,
    ref: Ints,
    partner: Ints,
    sweeps: Sequence[Sweep],
    left: Indices,
    found: Array,
) -> None:
    """Search the cells that are left with one sweep after the other; found: see `dense_ground`."""
    for s in sweeps:
        curve, peak = np.empty((len(left), len(s.heights)), np.float32), np.empty((len(left), 2))
        kernels.correlate(
            cameras.arrays, pictures, cells[left], plane[left], ref[left], partner[left], s.heights, s.half, s.step_m,
            _SWEEP_LEAST_VARIANCE, curve,
        )  # fmt: skip
        kernels.peaks(curve, s.heights, s.rival_m, _SWEEP_RIVAL_SHARE, peak)
        good = peak[:, 1] >= s.min_score
        found[left[good], :2], found[left[good], 2] = peak[good], s.sigma_m
        left = left[~good]

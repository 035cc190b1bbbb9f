"""Ground points between tie points: the vertical line locus method with several pictures.

At a free position the picture nearest to nadir is the reference. Partners before and behind it on the same leg (where
it ends too early, pictures of other legs) are compared with it at every height. A patch of the reference is rectified
on the local plane of the terrain, and so is a strip of each partner along its epipolar line there, on which a change of
height is a shift. Pictures are read one after the other along the legs, with only a window of them in memory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Gray, Indices, Ints
from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.features.working_pictures import shrunk
from orthoswarm.refine.surface import vertical_line_kernels as kernels

ReadPicture = Callable[[int], Gray]

REFERENCE_HEIGHT_M: Final = 150.0  # flying height for which lengths of patches are stated
_SWEEP_REACH_M: Final = 9.0  # heights searched above and below the terrain
_SWEEP_HEIGHT_STEP_M: Final = 0.375  # distance of the heights searched at reference height
_SWEEP_BASELINES_M: Final = (40.0, 75.0, 110.0)  # wished distances of partners on both sides, at reference height
_SWEEP_SPACING_M: Final = 17.0  # only pictures this far apart along a leg are used at reference height
_SWEEP_LEAST_BASELINE_SHARE: Final = 0.4  # least baseline as a share of the shortest that is wished
_SWEEP_PARTNERS: Final = 3  # partners below which pictures of other legs are asked for, where a leg ends
_SWEEP_RIVAL_M: Final = 4.0  # second peak farther than this from the best makes a height ambiguous at reference height
_SWEEP_RIVAL_SHARE: Final = 0.95  # ... if it is above this share of the best
_SWEEP_LEAST_VARIANCE: Final = 2.0  # least variance of a patch's grey values, squared: less is the noise of a JPEG
_SWEEP_STEEPEST: Final = 1.5  # steepest slope of a patch's plane: across a wall it is none
_SWEEP_SLOPE_REACH_M: Final = 5.0  # the slope below a patch is taken over this distance at least
_SWEEP_PICTURES: Final = 64  # pictures held at a time (memory)
_SMALL_PATCH_HALF: Final = 4  # half width of the small patch, samples: 9 x 9
_SMALL_PATCH_STEP_M: Final = 0.5
"""Distance of its samples at the reference height. It fits between cars, bushes and houses: on a street scene three
quarters of its heights lie within 0.2 m of bare ground, half of the large one's, most others above."""
_SMALL_PATCH_SCORE: Final = 0.7  # least mean normalised correlation of the small patch
_SMALL_PATCH_SIGMA_M: Final = 0.15  # sigma of its heights at the reference height (see `_SMALL_PATCH_STEP_M`)
_LARGE_PATCH_HALF: Final = 7  # half width of the large patch, samples (15 x 15): heights where texture is weak
_LARGE_PATCH_STEP_M: Final = 0.7  # distance of its samples at the reference height
_LARGE_PATCH_SCORE: Final = 0.6  # least mean normalised correlation of the large patch
_LARGE_PATCH_SIGMA_M: Final = 0.25  # sigma of its heights on open ground at the reference height


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

    @classmethod
    def small(cls) -> "Sweep":
        """Small patches, which fit between cars, bushes and houses, so that most of their heights are bare ground."""
        return cls(
            half=_SMALL_PATCH_HALF, step_m=_SMALL_PATCH_STEP_M, min_score=_SMALL_PATCH_SCORE,
            sigma_m=_SMALL_PATCH_SIGMA_M,
        )  # fmt: skip

    @classmethod
    def large(cls) -> "Sweep":
        """Large patches, for ground with little texture."""
        return cls(
            half=_LARGE_PATCH_HALF, step_m=_LARGE_PATCH_STEP_M, min_score=_LARGE_PATCH_SCORE,
            sigma_m=_LARGE_PATCH_SIGMA_M,
        )  # fmt: skip

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


@dataclass(frozen=True, slots=True)
class LocusPoints:
    """Points found by a sweep.

    Attributes:
        points: float64 (M, 3), on the reference's ray through the position, so slightly off the position.
        sigma_z: float64 (M,), one sigma of each height. score: float64 (M,), mean normalised correlation at the peak.
        cell: int64 (M,), which of the positions each point belongs to, ascending.
    """

    points: Array
    sigma_z: Array
    score: Array
    cell: Indices


def dense_ground(
    cameras: CameraBlock,
    gray: ReadPicture,
    cells: Array,
    *,
    terrain: Terrain,
    leg_of_camera: NDArray[np.integer],
    sweeps: Sequence[Sweep] | None = None,
    slots: int = _SWEEP_PICTURES,
) -> LocusPoints:
    """Heights at free positions from correlation between pictures, preferably of one leg.

    Args:
        gray: picture of a camera by its index, uint8 (rows, columns) as its lens says; called in the order of the
            legs, once per picture unless a window of `slots` pictures is too short.
        cells: float64 (C, 2), positions, east and north.
        terrain: surface around which heights are searched; its slope tilts the patches.
        leg_of_camera: int (N,), leg of each camera, -1 for cameras that must not be used.
        sweeps: applied in order, each to the positions where those before found nothing. Baselines and spacing are the
            first one's. None: small patches, then large, for the cameras' height above the terrain.
        slots: pictures in memory at a time (more only if the cells of one reference need more).
    """
    if sweeps is None:
        height = height_above(cameras, terrain)
        sweeps = (Sweep.small().at_height(height), Sweep.large().at_height(height))
    s = sweeps[0]
    cells = np.ascontiguousarray(cells, dtype=np.float64).reshape(-1, 2)
    plane = _planes(terrain, cells, max(_SWEEP_SLOPE_REACH_M, s.half * s.step_m))
    leg, camera, along = spaced_cameras(cameras, leg_of_camera, s.spacing_m)
    ref = np.full(len(cells), -1, np.int32)
    found = np.full((len(cells), 3), -1.0)
    if len(camera) and len(cells):
        wished = np.array([*s.baselines_m, *(-b for b in s.baselines_m)])
        partner = np.full((len(cells), len(wished)), -1, np.int32)
        least = _SWEEP_LEAST_BASELINE_SHARE * min(s.baselines_m)
        kernels.choose(
            cameras.arrays, (camera, leg, along), cells, plane, s.half * s.step_m, wished, least, _SWEEP_PARTNERS,
            ref, partner,
        )  # fmt: skip
        order = np.full(len(cameras), -1, np.int64)
        order[camera] = np.arange(len(camera))
        _sweep_in_windows(
            cameras, gray, order, cells, plane, ref=ref, partner=partner, sweeps=sweeps, slots=slots, found=found
        )
    good = np.flatnonzero(found[:, 1] >= 0.0)
    points = np.empty((len(good), 3))
    kernels.raise_points(cameras.position, ref[good], cells[good], plane[good], found[good, 0], points)
    return LocusPoints(points, found[good, 2], found[good, 1], good)


def height_above(cameras: CameraBlock, terrain: Terrain) -> float:
    """Median height of cameras above the terrain, metres, at least 1."""
    if len(cameras) == 0:
        return REFERENCE_HEIGHT_M
    return max(1.0, float(np.median(cameras.position[:, 2] - terrain.height(cameras.position[:, :2]))))


def spaced_cameras(
    cameras: CameraBlock, leg_of_camera: NDArray[np.integer], spacing_m: float
) -> tuple[Indices, Ints, Array]:
    """Cameras spaced along their legs, and each leg's last one: leg, camera and distance along it, sorted."""
    camera: list[int] = []
    leg: list[int] = []
    along: list[float] = []
    for number in np.unique(leg_of_camera[leg_of_camera >= 0]):
        members = np.flatnonzero(leg_of_camera == number)
        if len(members) < 2:
            continue
        p = cameras.position[members, :2]
        way = (p - p.mean(0)) @ np.linalg.svd(p - p.mean(0), full_matrices=False)[2][0]
        last = -np.inf
        rank = np.argsort(way)
        for i in rank:
            if way[i] >= last + spacing_m or i == rank[-1]:
                camera.append(int(members[i]))
                leg.append(int(number))
                along.append(float(way[i]))
                last = way[i]
    return np.array(leg, np.int64), np.array(camera, np.int32), np.array(along, np.float64)


def _planes(terrain: Terrain, cells: Array, reach: float) -> Array:
    """Height and slope (east, north) of the terrain at positions: float64 (C, 3)."""
    e, n = np.array([reach, 0.0]), np.array([0.0, reach])
    z = terrain.height(cells)
    ge = (terrain.height(cells + e) - terrain.height(cells - e)) / (2 * reach)
    gn = (terrain.height(cells + n) - terrain.height(cells - n)) / (2 * reach)
    return np.column_stack([z, np.clip(np.column_stack([ge, gn]), -_SWEEP_STEEPEST, _SWEEP_STEEPEST)])


def _sweep_in_windows(
    cameras: CameraBlock,
    gray: ReadPicture,
    order: Indices,
    cells: Array,
    plane: Array,
    *,
    ref: Ints,
    partner: Ints,
    sweeps: Sequence[Sweep],
    slots: int,
    found: Array,
) -> None:
    """Search all cells in the order of the legs, with a bounded stack of pictures in memory.

    found: float64 (C, 3), height over the plane, score, sigma of each cell; unchanged where nothing is found.
    """
    usable = np.flatnonzero(ref >= 0)
    if len(usable) == 0:
        return
    usable = usable[np.argsort(order[ref[usable]], kind="stable")]
    groups = [
        (a, b, {int(c) for c in np.unique(np.c_[ref[usable[a:b]], partner[usable[a:b]]]) if c >= 0})
        for a, b in pairwise(np.flatnonzero(np.r_[True, np.diff(ref[usable]) != 0, True]).tolist())
    ]
    slots = max(min(slots, int(order.max()) + 1), *(len(needed) for _, _, needed in groups))
    window = _Window(cameras, gray, _reduction(cameras, plane, ref, min(s.step_m for s in sweeps)), slots)
    factor = window.factor.astype(np.float64)

    def search(block: Indices, needed: set[int]) -> None:
        window.hold(sorted(needed, key=lambda camera: int(order[camera])))
        for s in sweeps:
            curve, peak = np.empty((len(block), len(s.heights)), np.float32), np.empty((len(block), 2))
            kernels.correlate(
                cameras.arrays, (window.stack, window.slot, factor), cells[block], plane[block], ref[block],
                partner[block], s.heights, s.half, s.step_m, _SWEEP_LEAST_VARIANCE, curve,
            )  # fmt: skip
            kernels.peaks(curve, s.heights, s.rival_m, _SWEEP_RIVAL_SHARE, peak)
            good = peak[:, 1] >= s.min_score
            found[block[good], :2], found[block[good], 2] = peak[good], s.sigma_m
            block = block[~good]

    begin, held = 0, set[int]()
    for a, _, needed in groups:
        if held and len(held | needed) > slots:
            search(usable[begin:a], held)
            begin, held = a, set()
        held |= needed
    search(usable[begin:], held)


class _Window:
    """The pictures in memory, reduced to the needed resolution: a stack, and each camera's slot in it."""

    def __init__(self, cameras: CameraBlock, gray: ReadPicture, factor: Indices, slots: int) -> None:
        self.factor = factor
        self.slot = np.full(len(cameras), -1, np.int32)
        sizes = cameras.lens[:, [HEIGHT, WIDTH]].astype(np.int64) // factor[:, None]
        self.stack = np.zeros((slots, int(sizes[:, 0].max()), int(sizes[:, 1].max())), np.uint8)
        self._lens_id, self._gray, self._free = cameras.lens_id, gray, list(range(slots))

    def hold(self, wanted: list[int]) -> None:
        """Read the pictures that are not in memory yet, into the slots of those no longer needed."""
        for camera in set(np.flatnonzero(self.slot >= 0).tolist()).difference(wanted):
            self._free.append(int(self.slot[camera]))
            self.slot[camera] = -1
        for camera in wanted:
            if self.slot[camera] < 0:
                place = self._free.pop()
                picture = shrunk(self._gray(camera), int(self.factor[self._lens_id[camera]]))
                self.stack[place, : picture.shape[0], : picture.shape[1]] = picture
                self.slot[camera] = place


def _reduction(cameras: CameraBlock, plane: Array, ref: Ints, step: float) -> Indices:
    """Integer by which each lens's pictures are reduced, so that pixels are not finer than the samples."""
    above = float(np.median(cameras.position[ref[ref >= 0], 2] - plane[ref >= 0, 0]))
    gsd = max(above, 1.0) / cameras.lens[:, F]
    return np.maximum(1, np.floor(step / gsd)).astype(np.int64)

"""Registration of leg patches on the map (paper III.D): compositing, dense matching, height filter, MAGSAC."""

from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Final

import numpy as np

from orthoswarm.matchers import Matches, map_matcher
from orthoswarm.matchers.matcher import Mask
from orthoswarm.matchers.patch_registration import LEAST_TILES, TRUSTED_SHARE, Registration, apply, register
from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import MapWindow
from orthoswarm.model.robust import mad_sigma
from orthoswarm.paper.coarse_cameras import PaperOptions
from orthoswarm.raster.picture_file import read_gray
from orthoswarm.refine.bundle.block_arrays import WIDTH, CameraBlock, F
from orthoswarm.refine.features.working_pictures import Pictures
from orthoswarm.refine.registration.orientation_correlation import strip_mosaic

_PATCH_SEARCH_M: Final = (30.0, 70.0)  # search radius of the first and the second attempt
_PATCH_GSD_M: Final = (0.3, 1.0)  # range of a patch's ground sampling distance: what suits learned matchers
_PATCH_MOST_PX: Final = 3_000_000  # most pixels of a patch; longer legs are drawn coarser (memory)
_PATCH_MOST_SEARCH_PX: Final = 240  # largest search radius (cost)
_PATCH_MARGIN_WIDTHS: Final = 1.5  # a patch extends beyond its positions by so many ground widths of a picture
_ROOF_DISTANCE_SHARE: Final = 0.15  # relief displacement is judged beyond this share of the height from the nadir
_ROOF_TOLERANCE_M: Final = 3.0  # a match whose apparent height differs from the median by more is dropped ...
_ROOF_SIGMAS: Final = 2.0  # ... if it also differs by more than so many standard deviations


@dataclass(frozen=True, slots=True)
class PatchTask:
    """A leg to be registered on the map; small, since it may be sent to another machine."""

    leg: int  # its number
    frames: list[Frame]  # the leg's frames
    cameras: CameraBlock  # their coarse cameras


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchFit:
    """Result of registering a leg's patch on the map."""

    leg: int  # which leg
    # float64 (3, 3), ground by the coarse cameras -> ground on the map, in metres relative to `centre`; None if the leg
    # was not found
    homography: Array | None
    centre: Array  # (2,), local frame
    share: float  # of tiles that agree
    rms_m: float  # of their residuals per axis
    gsd_m: float  # of the patch
    damaged: dict[str, str]  # image -> why it could not be used
    cpu_s: float  # what the task took
    wall_s: float  # what the task took

    def move(self, ground: Array) -> Array:
        """Corrected ground points (N, 2), local frame."""
        assert self.homography is not None
        return apply(self.homography, ground - self.centre) + self.centre

    @property
    def shift(self) -> Array:
        """Correction at the leg's centre, (2,), metres."""
        return np.asarray(self.move(self.centre[None])[0] - self.centre)


def match_patch(task: PatchTask, *, basemap: MapWindow, origin: Array, options: PaperOptions) -> PatchFit:
    """Register one leg on the map."""
    began, clock = process_time(), perf_counter()
    pictures = Pictures(task.frames, lambda f: read_gray(f.path), 10_000, cache_mb=8.0)
    centre = task.cameras.position[:, :2].mean(axis=0)
    gsd = patch_gsd(task.cameras, basemap.native_gsd_m)
    strip = strip_mosaic(task.cameras, np.arange(len(task.cameras)), pictures.gray, 0.0, gsd)
    found: Registration | None = None
    homography = None
    if strip is not None:
        patch, valid, west, north = strip
        own = GroundGrid(
            epsg=basemap.epsg, west=west, north=north, gsd_m=gsd, width=patch.shape[1], height=patch.shape[0]
        )
        for reach_m in _PATCH_SEARCH_M:
            reach = min(int(np.ceil(reach_m / gsd)), _PATCH_MOST_SEARCH_PX)
            window, known, there = map_window(basemap, origin, own, reach)
            if not known.any():
                break
            consistent = HeightFilter(task.cameras, own, there)
            matcher = map_matcher(options.map_matcher, options.device)
            found = register(patch, valid, window, known=known, reach=reach, matcher=matcher, keep=consistent)
            if found is not None and found.share >= TRUSTED_SHARE and len(found.matches) >= LEAST_TILES:
                homography = in_metres(found.homography, own, there, centre)
                break
    return PatchFit(
        leg=task.leg, homography=homography, centre=centre, share=0.0 if found is None else found.share,
        rms_m=float("nan") if found is None else found.rms_px * gsd, gsd_m=gsd,
        damaged={task.frames[i].image: why for i, why in pictures.damaged.items()}, cpu_s=process_time() - began,
        wall_s=perf_counter() - clock,
    )  # fmt: skip


def patch_gsd(cameras: CameraBlock, map_gsd_m: float) -> float:
    """GSD of a leg's patch, metres: the coarser of pictures and map; coarser still for long legs, to limit its size."""
    own = float(np.median(cameras.position[:, 2])) / float(cameras.lens[0, F])
    gsd = float(np.clip(max(own, map_gsd_m), *_PATCH_GSD_M))
    spread = np.ptp(cameras.position[:, :2], axis=0) + _PATCH_MARGIN_WIDTHS * own * float(cameras.lens[0, WIDTH])
    return max(gsd, float(np.sqrt(spread[0] * spread[1] / _PATCH_MOST_PX)))


def map_window(basemap: MapWindow, origin: Array, own: GroundGrid, reach: int) -> tuple[Floats, Mask, GroundGrid]:
    """The map around a patch (see MapMatcher), and its grid in the local frame.

    Map windows are aligned to multiples of the pixel in the area's grid, patches to those of the local frame. The two
    differ by a fraction of a pixel, which the returned grid contains.
    """
    gsd = own.gsd_m
    bounds = own.bounds.grown(reach * gsd).moved(float(origin[0]), float(origin[1]))
    grid = GroundGrid.around(basemap.epsg, bounds, gsd)
    gray, known = basemap.gray(bounds, gsd)
    rows, cols = own.height + 2 * reach, own.width + 2 * reach
    pad = ((0, max(0, rows - gray.shape[0])), (0, max(0, cols - gray.shape[1])))
    gray, known = np.pad(gray, pad)[:rows, :cols], np.pad(known, pad)[:rows, :cols]
    there = GroundGrid(
        epsg=basemap.epsg, west=grid.west - origin[0], north=grid.north - origin[1], gsd_m=gsd, width=cols, height=rows
    )
    return gray, known, there


def in_metres(pixels: Array, own: GroundGrid, there: GroundGrid, centre: Array) -> Array:
    """A homography of patch to window pixels as one of ground metres about a centre."""
    to_centre = np.array([[1.0, 0.0, centre[0]], [0.0, 1.0, centre[1]], [0.0, 0.0, 1.0]])
    from_patch = own.homography_from_ground() @ to_centre
    to_window = there.homography_from_ground() @ to_centre
    out = np.linalg.inv(to_window) @ pixels @ from_patch
    return np.asarray(out / out[2, 2])


@dataclass(frozen=True, slots=True)
class HeightFilter:
    """Rejects matches of inconsistent height (III.D): roofs and towers.

    A point at height h above the plane is displaced away from the nadir point of its picture by h rho / H, rho being
    its distance from the nadir point and H the flying height (relief displacement). The residual of a match along that
    direction gives an apparent height; matches far from the median height are rejected. Near the nadir points the
    displacement vanishes and no match is rejected.
    """

    cameras: CameraBlock  # the leg's cameras
    own: GroundGrid  # grid of the patch
    there: GroundGrid  # grid of the window

    def __call__(self, matches: Matches, homography: Array) -> Mask:
        """Which matches to keep, bool (N,)."""
        if not len(matches):
            return np.zeros(0, bool)
        ground = self.own.to_ground(matches.a)
        residual = self.there.to_ground(matches.b) - self.there.to_ground(apply(homography, matches.a))
        away = ground[:, None] - self.cameras.position[None, :, :2]
        nearest = np.argmin((away**2).sum(-1), axis=1)
        lever = away[np.arange(len(ground)), nearest]
        rho = np.hypot(*lever.T)
        height = np.maximum(self.cameras.position[nearest, 2], 1.0)
        leaning = rho > _ROOF_DISTANCE_SHARE * height
        apparent = (residual * lever).sum(1) / np.maximum(rho, 1e-6) * height / np.maximum(rho, 1e-6)
        if leaning.sum() < LEAST_TILES:
            return np.ones(len(matches), bool)
        usual = float(np.median(apparent[leaning]))
        spread = mad_sigma(apparent[leaning] - usual)
        return np.asarray(~leaning | (np.abs(apparent - usual) <= max(_ROOF_TOLERANCE_M, _ROOF_SIGMAS * spread)))

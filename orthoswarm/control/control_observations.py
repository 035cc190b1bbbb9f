"""Positions of surveyed points in a refined block: by the photos that show them, or by their position on the basemap.

Photos registered on the basemap and photos positioned by GNSS receivers are two frames of reference, each with its own
error. A point in photos of both gives one observation for each.
"""

from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Final

import numpy as np

from orthoswarm.evaluation.checkpoints import POINTING_SIGMA_PX, RECEIVERS_LOCAL_SIGMA_M, SURVEY_SIGMA_M, Checkpoint
from orthoswarm.evaluation.misread_points import FARTHEST_M, misplaced
from orthoswarm.evaluation.photo_names import photo_named, photos_named
from orthoswarm.evaluation.point_rays import Ray, RayPoint, intersect_rays
from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Ingest
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame, Terrain

_HEIGHT_SIGMA_M: Final = 2.0  # sigma of a point's height over the solved terrain below it


@dataclass(frozen=True, slots=True)
class ControlObservation:
    """A surveyed point in one frame of reference."""

    name: str  # of the point
    placed: Array  # float64 (2,), east and north in the block
    surveyed: Array  # float64 (2,), east and north by survey; same grid
    sigma_m: float  # of the difference, per axis: survey, pointing, and deformation of the block at that point
    stated: bool = True  # whether the survey's sigma is known; False where it is assumed
    _: KW_ONLY
    rays: RayPoint | None = None  # how its marks meet; None for a place on the basemap


def check_control(
    points: Sequence[Checkpoint], recorded: Sequence[PlacedFrame], grid: LocalGrid, has_map: bool
) -> None:
    """Refuse unusable control points before the work begins.

    Raises InputError: no point is marked in a photo or on the basemap, or one is far from all photos.
    """
    images = {p.frame.image: p for p in recorded}
    seen = [p for p in points if (has_map and p.on_map is not None) or _photos(p, images)]
    if not seen:
        raise InputError(
            f"none of the {len(points)} control points is seen in a photo with a position; check the "
            "names of the images"
        )
    nadirs = np.array([p.camera.nadir for p in recorded])
    elsewhere = []
    for point in seen:
        if not np.hypot(*(nadirs - _in_grid(point.surveyed, grid)).T).min() <= FARTHEST_M:  # infinite for no place
            own = [placed.camera.nadir for placed, _ in _photos(point, images)] or nadirs
            shown = grid.to_geographic(np.median(own, axis=0))[::-1] if point.on_map is None else point.on_map
            elsewhere.append((point.name, point.written, point.surveyed, shown))
    if elsewhere:
        raise InputError(f"of the control points, {misplaced(elsewhere)}")


def absent_marks(points: Iterable[Checkpoint], ingest: Ingest) -> list[str]:
    """A warning about points that are marked in photos which are not there, if there are any."""
    known = {f.image for f in ingest.frames} | {r.image for r in ingest.rejected}
    absent = [(p.name, m.image) for p in points for m in p.marks if not photos_named(known, m.image)]
    if not absent:
        return []
    name, image = absent[0]
    return [f"marks of control points in photos that are not here: {len(absent)}, the first of {name} in {image}"]


def in_photos(
    points: Sequence[Checkpoint], placed: Sequence[PlacedFrame], terrain: Terrain, grid: LocalGrid, on_map: bool
) -> list[ControlObservation]:
    """Points by the rays of the photos that show them.

    points: surveyed points. placed: photos of one frame of reference. terrain: ground below them. grid: the area's.
    on_map: whether that frame is the basemap.
    """
    images = {p.frame.image: p for p in placed}
    out = []
    for point in points:
        photos = _photos(point, images)
        if not photos:
            continue
        rays = [pixel_ray(p, pixel, RECEIVERS_LOCAL_SIGMA_M if not on_map else p.sigma_m) for p, pixel in photos]
        level = float(np.median([terrain.height(p.camera.nadir) for p, _ in photos]))
        place = intersect_rays(rays, level, _HEIGHT_SIGMA_M).place
        met = intersect_rays(rays, float(terrain.height(place)), _HEIGHT_SIGMA_M)
        gsd = float(np.median([(p.camera.position[2] - level) / p.camera.lens.focal_px for p, _ in photos]))
        pointing = POINTING_SIGMA_PX * gsd / np.sqrt(len(photos))
        bent = float(np.median([p.sigma_m for p, _ in photos])) if on_map else RECEIVERS_LOCAL_SIGMA_M
        parts = [_survey_sigma(point), pointing, bent, met.contradiction, _leaning_m(rays)]
        sigma = float(np.linalg.norm(parts))
        surveyed, stated = _in_grid(point.surveyed, grid), point.sigma_m > 0.0
        out.append(ControlObservation(point.name, met.place, surveyed, sigma, stated, rays=met))
    return out


def on_basemap(points: Iterable[Checkpoint], grid: LocalGrid, map_gsd_m: float) -> list[ControlObservation]:
    """Points by their position on the basemap, measured with a sigma of one pixel."""
    return [
        ControlObservation(
            point.name, _in_grid(point.on_map, grid), _in_grid(point.surveyed, grid),
            float(np.hypot(_survey_sigma(point), map_gsd_m)), point.sigma_m > 0.0,
        )
        for point in points
        if point.on_map is not None
    ]  # fmt: skip


def _photos(point: Checkpoint, images: dict[str, PlacedFrame]) -> list[tuple[PlacedFrame, Array]]:
    """The photos that show a point, and its pixel (2,) in each.

    Raises InputError: a pixel lies outside its photo, or a name belongs to several photos.
    """
    out = []
    for mark in point.marks:
        name = photo_named(images, mark.image)
        if name is None:
            continue
        frame = images[name].frame
        mark.check_inside(frame.width, frame.height)
        out.append((images[name], np.array([mark.column, mark.row])))
    return out


def _leaning_m(rays: Sequence[Ray]) -> float:
    """Sigma of a point of one photo by the height that nothing else tells, metres; 0 where rays meet."""
    if len(rays) > 1:
        return 0.0
    east, north, up = rays[0].direction
    return _HEIGHT_SIGMA_M * float(np.hypot(east, north) / max(abs(up), 1e-3))


def pixel_ray(placed: PlacedFrame, pixel: Array, camera_sigma_m: float) -> Ray:
    """The ray of a pixel, column and row (2,), of a picture whose camera may be so far off others, metres."""
    camera = placed.camera
    below = float(camera.position[2]) - 1.0
    away = np.array([*camera.to_ground(pixel, below), below]) - camera.position
    pixel_rad = POINTING_SIGMA_PX / camera.lens.focal_px
    return Ray(placed.frame.image, camera.position, away / np.linalg.norm(away), pixel_rad, camera_sigma_m)


def _survey_sigma(point: Checkpoint) -> float:
    return point.sigma_m or SURVEY_SIGMA_M


def _in_grid(lon_lat: Array, grid: LocalGrid) -> Array:
    return grid.to_grid(lon_lat[1], lon_lat[0])

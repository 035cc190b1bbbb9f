"""A surveyed point by the rays of the photos that show it, and the rays that miss it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array

MISTAKE_PROBABILITY: Final = 1e-3
"""A control point is left out if the others put it so far off with this probability only."""
_RELIEF_SIGMA_M: Final = 10.0  # ground off the area's level where rays do not tell: holds a point of one photo


@dataclass(frozen=True, slots=True)
class Ray:
    """A mark as a ray from the camera."""

    image: str  # the photo
    position: Array  # float64 (3,), the camera's, metres
    direction: Array  # float64 (3,), unit vector
    pixel_rad: float  # sigma of the mark, radians
    camera_sigma_m: float  # how far the camera may be off others, an axis, metres

    def sigma_m(self, ground_z_m: float) -> float:
        """Sigma across the ray where it meets the ground, metres."""
        return float(np.hypot(self.pixel_rad * _range_m(self.position, ground_z_m), self.camera_sigma_m))


@dataclass(frozen=True, slots=True)
class RayPoint:
    """Where rays meet."""

    place: Array  # float64 (2,), east and north
    miss_m: float  # root mean square of the rays' distances from it, metres
    left_out: tuple[tuple[str, float], ...] = ()  # photos of marks that all others contradict, and by how many metres
    # the largest distance of a ray where rays miss each other by more than their sigmas allow and none can be called
    # the wrong one, metres; 0 where they meet
    contradiction: float = 0.0

    def findings(self, name: str) -> list[str]:
        """What is wrong with the marks of a point, in plain words."""
        said = [
            f"point {name}: its mark in {image} was left out, for the other photos put the point {away:.1f} m from it; "
            "check the mark and the name of the photo"
            for image, away in self.left_out
        ]
        if self.contradiction > 0.0:
            said.append(
                f"point {name}: its marks contradict each other, the rays of its photos miss it by up to "
                f"{self.contradiction:.1f} m; check them and the names of the photos"
            )
        return said


def intersect_rays(rays: Sequence[Ray], ground_z_m: float, height_sigma_m: float | None = None) -> RayPoint:
    """The point at which rays meet, without the one that the others contradict.

    A ray is left out if without it the others meet, and this holds for no other ray: at least three are needed.

    Args:
        rays: of a point, at least one. ground_z_m: level of the ground there, metres.
        height_sigma_m: of the point's height over it, None: as configured.
    """
    every = list(rays)
    place, away, apart = _met(every, ground_z_m, height_sigma_m)
    limit = float(np.sqrt(-2.0 * np.log(MISTAKE_PROBABILITY)))
    if apart <= limit:
        return RayPoint(place, _rms(away))
    if len(every) > 2:
        without = [_met([*every[:k], *every[k + 1 :]], ground_z_m, height_sigma_m) for k in range(len(every))]
        order = np.argsort([w[2] for w in without])
        first, second = int(order[0]), int(order[1])
        if without[first][2] <= limit < without[second][2]:
            place, rest, _ = without[first]
            wrong = every[first]
            level = np.array([*place, ground_z_m])
            return RayPoint(place, _rms(rest), ((wrong.image, float(_distances([wrong], level)[0])),))
    return RayPoint(place, _rms(away), (), float(away.max()))


def intersection(
    rays: Sequence[tuple[Array, Array]],
    ground_z_m: float,
    height_sigma_m: float | None = None,
    pixel_rad: float = 1e-3,
) -> Array:
    """The point (3,) nearest to all rays; its height is held by the ground where they do not hold it.

    Every ray counts by its distance over the camera's range, so that a metre at 50 m height and two at 100 m are alike.

    Args:
        rays: camera position (3,) and unit direction (3,) of each. ground_z_m: level of the ground there, metres.
        height_sigma_m: of the point's height over it, None: as configured. pixel_rad: sigma of a ray, radians.
    """
    height_sigma_m = _RELIEF_SIGMA_M if height_sigma_m is None else height_sigma_m
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for position, direction in rays:
        distance = _range_m(position, ground_z_m)
        across = (np.eye(3) - np.outer(direction, direction)) / (pixel_rad * distance) ** 2
        normal += across
        right += across @ position
    normal[2, 2] += 1.0 / height_sigma_m**2
    right[2] += ground_z_m / height_sigma_m**2
    return np.asarray(np.linalg.solve(normal, right))


def _met(rays: Sequence[Ray], ground_z_m: float, height_sigma_m: float | None) -> tuple[Array, Array, float]:
    """The point (2,), the distances (n,) of the rays from it in metres, and the largest of them in sigmas."""
    pixel_rad = float(np.median([ray.pixel_rad for ray in rays]))
    point = intersection([(ray.position, ray.direction) for ray in rays], ground_z_m, height_sigma_m, pixel_rad)
    away = _distances(rays, point)
    if len(rays) < 2:
        return point[:2], away, 0.0
    sigma = np.array([ray.sigma_m(ground_z_m) for ray in rays])
    # A ray's own pull on the point makes its distance smaller than its error.
    return point[:2], away, float((away / sigma).max() / np.sqrt(1.0 - 1.0 / len(rays)))


def _distances(rays: Sequence[Ray], point: Array) -> Array:
    """Distances (n,) of a point (3,) from rays, metres."""
    return np.array([float(np.linalg.norm(np.cross(point - ray.position, ray.direction))) for ray in rays])


def _range_m(position: Array, ground_z_m: float) -> float:
    return max(float(position[2]) - ground_z_m, 1.0)


def _rms(away: Array) -> float:
    return float(np.sqrt(np.mean(np.square(away))))

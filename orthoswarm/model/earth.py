"""The Earth as a sphere: distances within a flight, right to 0.6 % of the ellipsoid's; and its size in web maps."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

MEAN_RADIUS_M = 6_371_008.8
"""Mean radius of the ellipsoid, (2 a + b) / 3 of GRS 80 (Moritz 2000, Journal of Geodesy 74)."""
DEGREE_M = math.radians(MEAN_RADIUS_M)  # length of a degree of a great circle, metres
EQUATOR_RADIUS_M = 6_378_137.0
"""Semi-major axis of WGS 84, metres; also the radius of the sphere of Web Mercator (EPSG 3857)."""
WEB_MERCATOR_M = 2.0 * math.pi * EQUATOR_RADIUS_M  # side of the square that holds the world in Web Mercator, metres


def distance_m(lat1_deg: float, lon1_deg: float, lat2_deg: float, lon2_deg: float) -> float:
    """Metres along a great circle between two places (haversine formula), also across the date line."""
    lat1, lat2 = math.radians(lat1_deg), math.radians(lat2_deg)
    half_lat, half_lon = 0.5 * (lat2 - lat1), 0.5 * math.radians(lon2_deg - lon1_deg)
    h = math.sin(half_lat) ** 2 + math.cos(lat1) * math.cos(lat2) * math.sin(half_lon) ** 2
    return 2.0 * MEAN_RADIUS_M * math.asin(math.sqrt(min(1.0, h)))


def on_sphere(lat_deg: ArrayLike, lon_deg: ArrayLike) -> NDArray[np.float64]:
    """Places as x, y, z from the Earth's middle, metres, float64 (N, 3), for straight distances anywhere."""
    lat, lon = np.radians(np.asarray(lat_deg, np.float64)), np.radians(np.asarray(lon_deg, np.float64))
    return MEAN_RADIUS_M * np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def ring_around(lat_deg: float, lon_deg: float, radius_m: float, corners: int) -> tuple[tuple[float, float], ...]:
    """Corners, latitude and longitude in degrees, of a regular polygon around a circle."""
    north = radius_m / math.cos(math.pi / corners) / DEGREE_M
    east = north / math.cos(math.radians(lat_deg))
    angles = [2.0 * math.pi * k / corners for k in range(corners)]
    return tuple((lat_deg + north * math.cos(a), lon_deg + east * math.sin(a)) for a in angles)

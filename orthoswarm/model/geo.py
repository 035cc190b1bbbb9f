"""Ground coordinates: the UTM grid of an area, its convergence, and the raster grid of a product.

Grid coordinates are (east, north) in metres of a WGS 84 / UTM zone; the grid's scale factor (0.9996 to 1.001)
is taken as 1. Latitudes and longitudes are degrees here, at the edge, and nowhere further in.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Frame

Array = NDArray[np.float64]


def utm_epsg(lat_deg: float, lon_deg: float) -> int:
    """EPSG code of the WGS 84 / UTM zone that holds a position (326xx north, 327xx south).

    The plain six-degree zones are used everywhere, Norway and Svalbard included.

    Raises:
        InputError: outside UTM (beyond 84 degrees north or 80 degrees south) or not a position.
    """
    if not (-80.0 <= lat_deg <= 84.0) or not np.isfinite(lon_deg):
        raise InputError(f"latitude {lat_deg:g}, longitude {lon_deg:g} lies outside the UTM grid; check the positions")
    zone = int(np.floor((lon_deg + 180.0) / 6.0)) % 60 + 1
    return (32600 if lat_deg >= 0 else 32700) + zone


def area_epsg(lat_deg: ArrayLike, lon_deg: ArrayLike) -> int:
    """EPSG code of the UTM zone for a set of positions: the zone of their median, also across the date line."""
    lat = np.asarray(lat_deg, dtype=np.float64)
    lon = np.asarray(lon_deg, dtype=np.float64)
    if lat.size == 0:
        raise InputError("no position was given, so no UTM zone can be chosen")
    mean = np.angle(np.exp(1j * np.radians(lon)).sum(), deg=True)
    offset = wrap_deg(lon - mean)
    median = wrap_deg(float(mean) + float(np.median(offset)))
    return utm_epsg(float(np.median(lat)), float(median))


@dataclass(frozen=True)
class LocalGrid:
    """A UTM grid: turns latitude and longitude into grid metres and back."""

    epsg: int  # EPSG code of a projected CRS in metres, normally WGS 84 / UTM

    @cached_property
    def _forward(self) -> Transformer:
        return Transformer.from_crs(4326, self.epsg, always_xy=True)

    @cached_property
    def crs(self) -> CRS:
        """The grid's CRS."""
        return CRS.from_epsg(self.epsg)

    def to_grid(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Grid coordinates of positions: float64 (..., 2), east and north in metres."""
        east, north = self._forward.transform(np.asarray(lon_deg, float), np.asarray(lat_deg, float))
        return np.stack([np.asarray(east, float), np.asarray(north, float)], axis=-1)

    def to_geographic(self, east_north: ArrayLike) -> Array:
        """Latitude and longitude in degrees, float64 (..., 2), of grid coordinates (..., 2)."""
        points = np.asarray(east_north, dtype=np.float64)
        lon, lat = self._forward.transform(points[..., 0], points[..., 1], direction="INVERSE")
        return np.stack([np.asarray(lat, float), np.asarray(lon, float)], axis=-1)

    def convergence_rad(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Meridian convergence in radians: grid azimuth = true azimuth - convergence."""
        lat = np.radians(np.asarray(lat_deg, float))
        central = (self.epsg % 100) * 6.0 - 183.0
        dlon = wrap_deg(np.asarray(lon_deg, float) - central)
        return np.asarray(np.arctan(np.tan(np.radians(dlon)) * np.sin(lat)), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundGrid:
    """The grid of a north-up raster: location, pixel size and extent."""

    epsg: int  # CRS of the raster
    west: float  # easting of the left edge (not of a pixel's centre), metres
    north: float  # northing of the upper edge, metres
    gsd_m: float  # side of a pixel, metres
    width: int  # columns
    height: int  # rows

    @classmethod
    def around(cls, epsg: int, bounds: BoundingBox, gsd_m: float) -> "GroundGrid":
        """The smallest grid that holds bounds (west, south, east, north), its edges on multiples of the GSD."""
        west, south, east, north = bounds
        left, top = float(np.floor(west / gsd_m)), float(np.ceil(north / gsd_m))
        width = max(1, int(np.ceil(east / gsd_m) - left))
        height = max(1, int(top - np.floor(south / gsd_m)))
        return cls(epsg=epsg, west=left * gsd_m, north=top * gsd_m, gsd_m=gsd_m, width=width, height=height)

    @classmethod
    def of_raster(cls, raster: Any) -> "GroundGrid":
        """The grid of an open north-up raster with square pixels."""
        return cls(
            epsg=int(raster.crs.to_epsg()), west=float(raster.bounds.left), north=float(raster.bounds.top),
            gsd_m=float(raster.res[0]), width=int(raster.width), height=int(raster.height),
        )  # fmt: skip

    @property
    def bounds(self) -> BoundingBox:
        """West, south, east, north edges in metres."""
        return BoundingBox(
            self.west,
            self.north - self.height * self.gsd_m,
            self.west + self.width * self.gsd_m,
            self.north,
        )

    def affine(self) -> Any:
        """The rasterio transform (pixel corner convention)."""
        from rasterio.transform import from_origin

        return from_origin(self.west, self.north, self.gsd_m, self.gsd_m)

    def to_pixel(self, east_north: ArrayLike) -> Array:
        """Column and row, float64 (..., 2), pixel CENTRES at integers, of ground points (..., 2)."""
        p = np.asarray(east_north, dtype=np.float64)
        return np.stack([(p[..., 0] - self.west) / self.gsd_m - 0.5, (self.north - p[..., 1]) / self.gsd_m - 0.5], -1)

    def to_ground(self, column_row: ArrayLike) -> Array:
        """Easting and northing, float64 (..., 2), of pixel positions (..., 2), pixel CENTRES at integers."""
        p = np.asarray(column_row, dtype=np.float64)
        return np.stack([self.west + (p[..., 0] + 0.5) * self.gsd_m, self.north - (p[..., 1] + 0.5) * self.gsd_m], -1)

    def homography_from_ground(self) -> Array:
        """The 3x3 matrix from (east, north, 1) to (column, row, 1), pixel CENTRES at integers."""
        s = 1.0 / self.gsd_m
        return np.array([[s, 0, -self.west * s - 0.5], [0, -s, self.north * s - 0.5], [0, 0, 1.0]])


def local_origin(grid: LocalGrid, frames: Iterable[Frame]) -> Array:
    """Origin (2,) of an area's local frame: the middle of the fixes, on a multiple of 16 m: pixel grids agree."""
    fixes = np.array([(f.fix.lat_deg, f.fix.lon_deg) for f in frames])
    return np.asarray(np.round(np.median(grid.to_grid(fixes[:, 0], fixes[:, 1]), axis=0) / 16.0) * 16.0)

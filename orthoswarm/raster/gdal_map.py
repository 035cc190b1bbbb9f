"""A map in a file that GDAL reads: windows on the area's grid, as 8-bit values with a validity mask."""

import os
import threading
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Bytes, Flags, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.coordinate_system import require_datum
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid
from orthoswarm.raster.empty_pixels import blank, fills, range_of_ground
from orthoswarm.raster.kept_ranges import STRETCH_PERCENT
from orthoswarm.raster.map_check import UnreadableMapError, ends_early
from orthoswarm.raster.resampling import resample
from orthoswarm.stores.addresses import is_stored
from orthoswarm.stores.local_copies import local_file

# GDAL keeps 5 % of the machine's memory in blocks otherwise, in every process; it reads this at its first block.
os.environ.setdefault("GDAL_CACHEMAX", "64")

_MAP_PIXELS_AT_ONCE: Final = 8_000_000  # pixels of a map read at once (memory)
_CUBIC_PX: Final = 2  # pixels on either side that cubic interpolation mixes
_SAMPLE_SIDE: Final = 6  # windows a side of the lattice that is searched for plain fill ...
_SAMPLE_PX: Final = 48  # ... and their side, pixels
_OPAQUE_PERCENT: Final = 99.0  # of what is not transparent: a few brighter pixels say nothing of the rest
_CLEAR_SHARE: Final = 0.05  # up to this share of the opaque value a pixel is transparent, with the noise of JPEG ...
_SOLID_SHARE: Final = 0.9  # ... and from this on opaque: between lie edges of an alpha, but most of a picture, ...
_ALPHA_VALUES: Final = 16  # ... in more values than layers of different opacity have


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Scaling of stored values to 8 bit: per band, low to 0 and high to 255."""

    low: Floats
    high: Floats

    def apply(self, data: NDArray[Any]) -> Bytes:
        low, high = self.low[:, None, None], self.high[:, None, None]
        inside = np.clip(np.nan_to_num(data.astype(np.float32)), low, high)
        return np.asarray((inside - low) * (255.0 / (high - low)) + 0.5).astype(np.uint8)


class RasterMap:
    """A file that GDAL reads. Handles belong to one thread of one process; each opens its own.

    native_gsd_m: size of the map's own pixel on the ground of the area, metres. bounds: west, south, east, north in the
    area's grid; of a huge map, of the part near the area.
    """

    def __init__(self, path: Path, epsg: int, near: BoundingBox | None) -> None:
        from rasterio.errors import RasterioError

        self._error = RasterioError
        self._path = path
        self._epsg = epsg
        self._handles = threading.local()
        self._virtual: str | None = None
        source = self._open()
        self._crs = _crs_of(source, path)
        self.native_gsd_m, self.bounds = _placement(source, self._crs, path, epsg, near)
        t = source.transform
        self._affine = _affine_of(source)
        self._aligned = t.b == 0 and t.d == 0 and t.a > 0 > t.e and self._crs.to_epsg() == epsg
        self._ground, self._area = (-np.inf, np.inf), near or self.bounds
        with self._reading():
            self._virtual = self._as_shown(source)
        source = self._open()
        self._bands, self._alpha = _band_roles(source)
        self._opaque = self._alpha is None and not _mask_flags(source) & {"nodata", "per_dataset"}
        self._factors = [int(f) for f in source.overviews(1)]
        eight_bit = all(source.dtypes[b - 1] == "uint8" for b in self._bands)
        with self._reading():
            self._stretch = None if eight_bit else self._limits(epsg)

    def _open(self, level: int | None = None, as_shown: bool = True) -> Any:
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

        handles: dict[Any, Any] = self._handles.__dict__
        virtual = self._virtual if as_shown else None
        key = (os.getpid(), level, virtual)
        if key not in handles:
            options: dict[str, Any] = {} if level is None else {"OVERVIEW_LEVEL": level}
            # Of a local map side files are looked for one by one (world file, .aux.xml, .msk, .ovr) without listing its
            # folder, which may hold thousands of photos; asking a store for each of them would take seconds.
            side_files = "EMPTY_DIR" if is_stored(self._path) else "TRUE"
            try:
                with warnings.catch_warnings(), rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN=side_files):
                    warnings.simplefilter("ignore", NotGeoreferencedWarning)  # reported as an error in plain words
                    file = local_file(self._path)
                    handles[key] = rasterio.open(virtual or file, **options)
            except (RasterioIOError, OSError):
                raise UnreadableMapError(
                    f"the basemap {self._path.name} cannot be read as a map; give a GeoTIFF, COG, MBTiles or XYZ folder"
                ) from None
        return handles[key]

    def _as_shown(self, source: Any) -> str | None:
        """A virtual raster (VRT) of the file that is what it says; None if the file itself is.

        A palette becomes colours, and an alpha's opaque value its highest. A picture that is labelled alpha, as
        programs label any fourth band, becomes a band without a meaning. Overviews without the file's mask, by which
        all of them would be valid, are left out; GDAL does so itself.
        """
        from rasterio.enums import ColorInterp

        roles = list(source.colorinterp)
        if not {ColorInterp.alpha, ColorInterp.palette} & set(roles) and "per_dataset" not in _mask_flags(source):
            return None
        root = virtual_raster(source)
        bands = stored = root.findall("VRTRasterBand")
        if ColorInterp.alpha in roles:
            at = roles.index(ColorInterp.alpha)
            kind, full = stored[at].get("dataType", "Byte"), _alpha_range(source.dtypes[at])
            opaque = self._opaque_value(at + 1, full)
            if opaque is None or opaque <= 0.5 * full:
                role, scale = ("Undefined", 1.0) if opaque is None else ("Alpha", full / opaque)
                band = virtual_band(source, at + 1, role, kind, ScaleRatio=scale)
                bands = [*stored[:at], band, *stored[at + 1 :]]
        if ColorInterp.palette in roles:
            alphas = [band for band in bands if band.findtext("ColorInterp") == "Alpha"]
            bands = [*_palette_colours(source, roles.index(ColorInterp.palette) + 1), *alphas][:4]
        if bands == stored and ColorInterp.alpha in roles:
            return None
        root[:] = [*(part for part in root if part not in stored), *bands]
        return ET.tostring(root, "unicode")

    def _opaque_value(self, band: int, full: float) -> float | None:
        """What a band labelled alpha holds where the map is opaque, full if no sample tells; None of a picture."""
        values = np.concatenate([np.zeros(0), *(window.ravel() for window in self._samples([band]))])
        if not (values > 0).any():
            return full
        opaque = float(np.percentile(values[values > 0], _OPAQUE_PERCENT))
        seen = values[values > _CLEAR_SHARE * opaque]
        middle = seen[seen < _SOLID_SHARE * opaque]
        return None if 2 * len(middle) > len(seen) and len(np.unique(middle)) > _ALPHA_VALUES else opaque

    def gsds(self) -> list[float]:
        """A pixel size for each stored resolution, metres."""
        return [self.native_gsd_m, *(2.0 * f * self.native_gsd_m for f in self._factors)]

    def require_complete(self, bounds: BoundingBox) -> None:
        """Raise UnreadableMapError if the file is too short for its blocks within bounds (in the area's grid)."""
        from rasterio.warp import transform_bounds

        west, south, east, north = transform_bounds(f"EPSG:{self._epsg}", self._crs, *bounds, densify_pts=5)
        corners = np.array([_apply(~self._affine, x, y) for x in (west, east) for y in (south, north)])
        (c0, r0), (c1, r1) = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
        source = self._open(as_shown=False)
        rows, cols = np.clip([r0, r1], 0, source.height), np.clip([c0, c1], 0, source.width)
        if ends_early(source, local_file(self._path), (int(rows[0]), int(rows[1]), int(cols[0]), int(cols[1]))):
            raise UnreadableMapError(f"the basemap {self._path.name} is cut short; copy or export it again")

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Turn GDAL's errors into plain words."""
        try:
            yield
        except (self._error, OSError) as error:
            raise UnreadableMapError(
                f"the basemap {self._path.name} is damaged ({_short(error)}); copy or export it again"
            ) from None

    def read(self, grid: GroundGrid, gray: bool) -> tuple[Bytes, Flags]:
        """Values uint8 (bands, rows, columns), one or three bands (one if grey is enough), and their validity."""
        with self._reading():
            if self._aligned:
                parts = [self._read_aligned(part, gray) for part in self._bands_of(grid)]
                return parts[0] if len(parts) == 1 else _below_each_other(parts)
            data, valid = self._warp(grid)
        ratio = grid.gsd_m / self.native_gsd_m
        valid &= self._shown(data, mixed_px=int(np.ceil(_CUBIC_PX / min(ratio, 1.0))))
        return self._eight_bit(data), valid

    def _eight_bit(self, data: NDArray[Any]) -> Bytes:
        return self._stretch.apply(data) if self._stretch is not None else np.asarray(data, np.uint8)

    def _shown(self, data: NDArray[Any], mixed_px: int) -> Flags:
        """Where values (bands, rows, columns) can be ground, bool (rows, columns).

        mixed_px: pixels beside empty ones that are mixed with them.
        """
        import cv2

        shown = self._in_range(data)
        if mixed_px and not shown.all():
            side = 2 * mixed_px + 1
            shown = cv2.erode(shown.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool)
        if self._opaque:
            shown &= ~blank(data, self._fills)
        return shown

    def _in_range(self, data: NDArray[Any]) -> Flags:
        low, high = self._ground
        if data.dtype.kind != "f" and low == -np.inf and high == np.inf:
            return np.ones(data.shape[1:], bool)
        return np.asarray(((data > low) & (data < high)).all(axis=0))  # not true of what is no number

    @cached_property
    def _fills(self) -> list[tuple[float, ...]]:
        """Colours in which the map is plain without being ground, besides black and white."""
        low, high = self._ground
        return [colour for colour in fills(self._samples(self._bands)) if low < min(colour) and max(colour) < high]

    def _samples(self, bands: Sequence[int]) -> Iterator[NDArray[Any]]:
        """Windows of bands of the map at its own resolution, spread over the area."""
        from rasterio.windows import Window

        source = self._open()
        for c, r in self._lattice(self._area):
            left = min(max(c - _SAMPLE_PX // 2, 0), max(source.width - _SAMPLE_PX, 0))
            top = min(max(r - _SAMPLE_PX // 2, 0), max(source.height - _SAMPLE_PX, 0))
            size = min(_SAMPLE_PX, source.width), min(_SAMPLE_PX, source.height)
            with suppress(self._error):  # what is damaged is told where it is needed
                yield source.read(bands, window=Window(left, top, *size))

    def _lattice(self, bounds: BoundingBox) -> Iterator[tuple[int, int]]:
        """Columns and rows of the map at places spread over bounds, those inside it."""
        from rasterio.warp import transform

        west, south, east, north = bounds
        share = (np.arange(_SAMPLE_SIDE) + 0.5) / _SAMPLE_SIDE
        x, y = (v.ravel() for v in np.meshgrid(west + share * (east - west), south + share * (north - south)))
        inverse, source = ~self._affine, self._open()
        for place in zip(*transform(f"EPSG:{self._epsg}", self._crs, x, y), strict=True):
            column, row = (int(v) if np.isfinite(v) else -1 for v in _apply(inverse, *place))
            if 0 <= column < source.width and 0 <= row < source.height:
                yield column, row

    def _level(self, grid: GroundGrid) -> int | None:
        """The overview to read from; at least twice finer than needed, since its resampling method is unknown."""
        ratio = grid.gsd_m / self.native_gsd_m
        usable = [i for i, f in enumerate(self._factors) if f <= ratio / 2]
        return usable[-1] if usable else None

    def _bands_of(self, grid: GroundGrid) -> list[GroundGrid]:
        """A grid in bands of rows, to limit the pixels read at once from maps without overviews."""
        t = self._open(self._level(grid)).transform
        read = grid.width * (grid.gsd_m / t.a) * (grid.gsd_m / -t.e)
        rows = max(1, int(_MAP_PIXELS_AT_ONCE / max(read, 1.0)))
        return [
            replace(grid, north=grid.north - top * grid.gsd_m, height=min(rows, grid.height - top))
            for top in range(0, grid.height, rows)
        ]

    def _read_aligned(self, grid: GroundGrid, gray: bool) -> tuple[Bytes, Flags]:
        """A window of a north-up raster in the area's CRS: several times cheaper than warping."""
        from rasterio.windows import Window

        source = self._open(self._level(grid))
        t = source.transform
        west, south, east, north = grid.bounds
        margin = 4 + int(max(0.0, grid.gsd_m / t.a - 4.0))
        c0, c1 = int((west - t.c) / t.a) - margin, int((east - t.c) / t.a) + 1 + margin
        r0, r1 = int((north - t.f) / t.e) - margin, int((south - t.f) / t.e) + 1 + margin
        c0, c1 = max(c0, 0), min(c1, source.width)
        r0, r1 = max(r0, 0), min(r1, source.height)
        if c0 >= c1 or r0 >= r1:
            bands = 1 if gray else len(self._bands)
            return np.zeros((bands, grid.height, grid.width), np.uint8), np.zeros((grid.height, grid.width), bool)
        window = Window(c0, r0, c1 - c0, r1 - r0)
        data = source.read(self._bands, window=window)
        valid = self._shown(data, mixed_px=int(t.a > self._affine.a))
        if not self._opaque:
            valid &= source.dataset_mask(window=window) > 127
        data = self._eight_bit(data)
        if gray:
            data = luma(data)
        scale = (grid.gsd_m / t.a, grid.gsd_m / -t.e)
        first = ((west - t.c) / t.a - c0, (north - t.f) / t.e - r0)
        return resample(data, valid, first, scale, (grid.width, grid.height))

    def _warp(self, grid: GroundGrid, nearest: bool = False) -> tuple[NDArray[Any], Flags]:
        """The bands and the validity of a window, warped; averaged where it is coarser than the map."""
        from rasterio.enums import Resampling
        from rasterio.vrt import WarpedVRT

        ratio = grid.gsd_m / self.native_gsd_m
        source = self._open(self._level(grid))
        how = Resampling.nearest if nearest else Resampling.average if ratio >= 2 else Resampling.cubic
        options: dict[str, Any] = {
            "src_crs": self._crs,
            "crs": f"EPSG:{grid.epsg}",
            "transform": grid.affine(),
            "width": grid.width,
            "height": grid.height,
            "resampling": how,
            "tolerance": 0.01,
            "add_alpha": self._alpha is None,
            "warp_mem_limit": 32,
        }
        with WarpedVRT(source, **options) as vrt:
            bands = vrt.read([*self._bands, self._alpha or vrt.count])
        full = 255 if self._alpha is None else _alpha_range(source.dtypes[self._alpha - 1])
        valid = bands[-1] > 0.5 * full
        return bands[:-1], valid

    def _limits(self, epsg: int) -> _Stretch:
        """Percentiles of the map near the area, from about half a million pixels."""
        west, south, east, north = self.bounds
        side = max(self.native_gsd_m, float(np.sqrt((east - west) * (north - south) / 5e5)))
        data, valid = self._warp(GroundGrid.around(epsg, self.bounds, side), nearest=True)
        if data.dtype.kind == "f":
            valid &= np.isfinite(data).all(axis=0)
        self._ground = range_of_ground(data[:, valid].ravel())
        valid &= self._in_range(data)
        low, high = np.zeros(len(data), np.float32), np.ones(len(data), np.float32)
        for i, band in enumerate(data):
            values = band[valid]
            if values.size:
                low[i], high[i] = np.percentile(values.astype(np.float64), STRETCH_PERCENT)
            if not high[i] > low[i]:
                high[i] = low[i] + 1.0
        return _Stretch(low, high)


def _below_each_other(parts: list[tuple[Bytes, Flags]]) -> tuple[Bytes, Flags]:
    return np.concatenate([data for data, _ in parts], axis=1), np.concatenate([valid for _, valid in parts])


def luma(data: Bytes) -> Bytes:
    """Grey uint8 (1, rows, columns) of one or three bands."""
    import cv2

    if len(data) == 1:
        return data
    return np.asarray(cv2.cvtColor(cv2.merge(list(data)), cv2.COLOR_RGB2GRAY))[None]


def _crs_of(source: Any, path: Path) -> Any:
    """The raster's CRS, from its ground control points where it has no transform, or of a .prj beside a world file."""
    if not source.count:
        parts = source.subdatasets or [path.name]
        raise InputError(
            f"the basemap {path.name} holds {len(parts)} rasters ({', '.join(parts)}); extract one of them "
            f"(gdal_translate '{parts[0]}' map.tif) and give that"
        )
    crs = source.crs or source.gcps[1] or (None if source.transform.is_identity else _crs_beside(path))
    if source.crs and source.transform.is_identity and not source.gcps[0] and not source.rpcs:
        crs = None
    if not crs:
        raise InputError(
            f"the basemap {path.name} has no coordinate system (CRS); georeference it, for example with QGIS, or give "
            "another map"
        )
    require_datum(crs.to_wkt(), f"the basemap {path.name}")
    return crs


def _crs_beside(path: Path) -> Any:
    """The CRS of a .prj file as shapefiles have them, which GDAL does not read of pictures; None without one."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    beside = path.with_suffix(".prj")
    if is_stored(path) or not beside.is_file():
        return None
    try:
        return CRS.from_user_input(beside.read_text("utf-8", "replace").strip())
    except CRSError:
        return None


def _band_roles(source: Any) -> tuple[list[int], int | None]:
    """Band numbers of the picture (one or three) and of the alpha."""
    from rasterio.enums import ColorInterp

    roles = list(source.colorinterp)
    alpha = roles.index(ColorInterp.alpha) + 1 if ColorInterp.alpha in roles else None
    colours = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if all(c in roles for c in colours):
        return [roles.index(c) + 1 for c in colours], alpha
    plain = [i + 1 for i in range(source.count) if i + 1 != alpha]
    return (plain[:3] if len(plain) >= 3 else plain[:1]), alpha


def _mask_flags(source: Any) -> set[str]:
    """GDAL's names of all that tells which pixels are valid."""
    return {flag.name for band in source.mask_flag_enums for flag in band}


def virtual_raster(source: Any) -> ET.Element:
    """GDAL's description (VRT) of an open raster; changed as XML, it can be opened in the raster's place."""
    import rasterio.shutil
    from rasterio.io import MemoryFile

    with MemoryFile(ext=".vrt") as file:
        rasterio.shutil.copy(source, file.name, driver="VRT")
        root = ET.fromstring(file.read())
    for name in root.iter("SourceFilename"):
        name.set("shared", "0")  # a file that is shared with the process this one was forked from would be read by both
    return root


def virtual_band(source: Any, number: int, role: str, kind: str, **how: Any) -> ET.Element:
    """A band of a virtual raster whose values are changed as they are read.

    source, number: the open raster and its band. role, kind: meaning and data type, as GDAL names them. how: elements
    of a VRT's ComplexSource (https://gdal.org/drivers/raster/vrt.html).
    """
    high, wide = source.block_shapes[number - 1]
    band = ET.Element("VRTRasterBand", dataType=kind, blockXSize=str(wide), blockYSize=str(high))
    ET.SubElement(band, "ColorInterp").text = role
    values = ET.SubElement(band, "ComplexSource")
    ET.SubElement(values, "SourceFilename", shared="0").text = source.name
    for name, value in {"SourceBand": number, **how}.items():
        ET.SubElement(values, name).text = str(value)
    return band


def _palette_colours(source: Any, number: int) -> list[ET.Element]:
    """Bands of a palette's colours, and of their alpha where some are transparent."""
    nodata = source.nodatavals[number - 1]
    clear = nodata is not None or any(colour[3] < 255 for colour in source.colormap(number).values())
    how = {} if nodata is None else {"NODATA": nodata}
    roles = ("Red", "Green", "Blue", "Alpha")[: 4 if clear else 3]
    return [virtual_band(source, number, r, "Byte", ColorTableComponent=i, **how) for i, r in enumerate(roles, 1)]


def _placement(source: Any, crs: Any, path: Path, epsg: int, near: BoundingBox | None) -> tuple[float, BoundingBox]:
    """Pixel size on the ground and bounds in the area's grid; of a huge map, of the part around the area."""
    from rasterio.errors import CRSError, RasterioError
    from rasterio.warp import transform, transform_bounds

    target = f"EPSG:{epsg}"
    affine = _affine_of(source)
    corners = np.array([_apply(affine, *p) for p in _ring(source.width, source.height)])
    own = BoundingBox.around_points(corners)
    try:
        if near is not None:
            margin = max(5000.0, 2 * near.width, 2 * near.height)
            there = BoundingBox(*transform_bounds(target, crs, *near.grown(margin), densify_pts=5))
            cut = own.intersection(there)
            if not cut.empty:
                own = cut
        bounds = BoundingBox(*(float(v) for v in transform_bounds(crs, target, *own, densify_pts=21)))
        middle = _apply(~affine, *own.center)
        steps = [_apply(affine, middle[0] + dx, middle[1] + dy) for dx, dy in ((0, 0), (1, 0), (0, 1))]
        x, y = (np.array(v) for v in transform(crs, target, *zip(*steps, strict=True)))
    except (CRSError, RasterioError) as error:
        raise InputError(
            f"the basemap {path.name} cannot be brought to the area's grid ({_short(error)}); check its CRS"
        ) from None
    size = np.sqrt(abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])))
    if not (np.isfinite(bounds).all() and np.isfinite(size) and size > 0):
        raise InputError(f"the basemap {path.name} lies outside the area's grid; give a map of this area")
    return float(size), bounds


def _affine_of(source: Any) -> Any:
    """From pixels to the raster's CRS; fitted to its ground control points where it has no transform."""
    from rasterio.transform import from_gcps

    return from_gcps(source.gcps[0]) if source.gcps[0] and not source.crs else source.transform


def _apply(affine: Any, x: float, y: float) -> tuple[float, float]:
    return affine.a * x + affine.b * y + affine.c, affine.d * x + affine.e * y + affine.f


def _ring(width: int, height: int) -> list[tuple[float, float]]:
    """Points on the raster's border, in pixels."""
    steps = np.linspace(0.0, 1.0, 5)
    ring = [(s * width, t * height) for s in steps for t in (0.0, 1.0)]
    return ring + [(t * width, s * height) for s in steps for t in (0.0, 1.0)]


def _alpha_range(dtype: str) -> float:
    return float(np.iinfo(dtype).max) if np.dtype(dtype).kind in "iu" else 1.0


def _short(error: Exception) -> str:
    return str(error).splitlines()[0][:120]

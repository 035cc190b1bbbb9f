"""The user's height model: a GeoTIFF of any CRS as terrain of the area, relative to the takeoff level."""

import re
import warnings
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from orthoswarm.model.arrays import Array, Flags, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.coordinate_system import require_datum
from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import Terrain
from orthoswarm.raster.gdal_map import virtual_band, virtual_raster
from orthoswarm.stores.addresses import address_of
from orthoswarm.stores.listing import exists
from orthoswarm.stores.local_copies import local_file

_US_FOOT_M = 1200.0 / 3937.0
_METRES = {
    **dict.fromkeys(("", "m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet"), 0.3048),
    **dict.fromkeys(("us ft", "ft us", "ftus", "usft", "us foot", "us feet", "foot us", "feet us"), _US_FOOT_M),
    **dict.fromkeys(("us survey foot", "us survey feet", "survey foot", "survey feet", "sft"), _US_FOOT_M),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("dm", "decimetre", "decimetres", "decimeter", "decimeters"), 0.1),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), 0.001),
    **dict.fromkeys(("km", "kilometre", "kilometres", "kilometer", "kilometers"), 1000.0),
}
"""Metres of a unit, spelt as GDAL, PROJ ("us-ft"), WKT ("US survey foot") and WKT of Esri ("Foot_US") do."""

_MOST_WORDS = max(len(unit.split()) for unit in _METRES)
_NO_UNIT = frozenset({"unknown", "none", "unitless", "1"})
"""Words of a unit that states none: metres, as where it is empty."""

_BETWEEN_NODES = 1.5  # how far the nodes around a place and the node of a pixel are from them, together, in steps

_LOWEST_M: Final = -600.0  # below this no land lies over any datum (the least is -430 m): it is a void, as is what ...
_HIGHEST_M: Final = 12_000.0  # ... lies above this; feet that are taken for metres are below it nearly everywhere
_VOID_M: Final = -1e6  # a void's height until pixels are mixed, which leaves it out
_DEM_FINEST_M: Final = 2.0  # finest distance of the nodes on which a height model is read
_DEM_MEAN_STEPS: Final = 0.7  # where its pixels are smaller than so many distances of nodes, a node has their mean ...
_DEM_HIGHEST_STEPS: Final = 1.5  # ... or the highest of them where the highest ground is asked for
DEM_MOST_NODES: Final = 4_000_000  # most nodes read from a height model as a whole (memory)
_DEM_WINDOW_NODES: Final = 250_000  # most nodes of a window of it (memory)
_DEM_MOST_BURIED: Final = 0.05  # share of the cameras that a height model may bury: a few recorded heights can be wrong
_DEM_LEAST_COVER: Final = 0.02  # height model with heights on a smaller share of the area than this is of another place


@dataclass(frozen=True, slots=True)
class KnownGround:
    """Heights of a DEM in a window.

    terrain: heights above the model's zero; smoothly filled where the DEM has none. known: bool (rows, columns), nodes
    where it has.
    """

    terrain: Terrain
    known: Flags

    def knows(self, east_north: Array) -> Flags:
        """Whether the DEM has heights all around positions (M, 2)."""
        t = self.terrain
        c, r = (east_north[..., 0] - t.west) / t.step_m, (east_north[..., 1] - t.south) / t.step_m
        rows, columns = self.known.shape
        inside = (c >= 0) & (r >= 0) & (c <= columns - 1) & (r <= rows - 1)
        share = Terrain(t.west, t.south, t.step_m, self.known.astype(np.float32)).height(east_north)
        return np.asarray(inside & (share > 0.999))


@dataclass(frozen=True, slots=True)
class HeightModel:
    """A checked DEM: its location and zero level. Heights are read where and when they are needed.

    It is small, so that it can be part of a task for another process; the file must have the same path there.

    path: the file. epsg: CRS of the area. zero_m: height in the DEM's own datum that counts as 0: the ground in the
    middle below the cameras. cover: share of the area on which it has heights.
    """

    path: Path
    epsg: int
    zero_m: float
    cover: float

    @classmethod
    def open(cls, path: Path, epsg: int, bounds: BoundingBox, cameras: ArrayLike) -> "HeightModel":
        """Check a DEM before the work starts.

        Args:
            path: a GeoTIFF (or anything that GDAL reads) with a CRS. epsg: CRS of the area.
            bounds: west, south, east, north of the area.
            cameras: (N, 3) east, north and height above takeoff; NaN for an unknown height.

        Raises:
            InputError: if it cannot be read, has no CRS, no heights on the area, or buries cameras.
        """
        ground = _window(path, epsg, bounds, DEM_MOST_NODES)
        cover = float(ground.known.mean())
        if cover < _DEM_LEAST_COVER:
            raise InputError(_no_cover(path, epsg, bounds, cover))
        at = np.asarray(cameras, float).reshape(-1, 3)
        at = at[ground.knows(at[:, :2])]
        below = ground.terrain.height(at[:, :2]) if len(at) else ground.terrain.z[ground.known].astype(np.float64)
        zero = float(np.median(below))
        if len(at):
            _refuse_buried(path, below - zero, at[:, 2])
        return cls(Path(path).absolute(), epsg, zero, cover)

    def highest(self, bounds: BoundingBox, within_m: float, steps: float, most_nodes: int) -> Terrain:
        """The highest ground up to a distance from each place, over `zero_m`, in the area's CRS.

        It is made of the DEM's highest pixels, where `window` has the mean of those about a node, and reaches up to
        one and a half steps farther, so that what lies between nodes is not lost.

        bounds: west, south, east, north. within_m: the distance. steps: nodes on it at least, where the DEM is coarser,
        as far as there are not more than `most_nodes`.
        """
        z, west, south, step_m = _on_area(self.path, self.epsg, bounds, most_nodes, highest_step_m=within_m / steps)
        known = np.isfinite(z)
        z = _filled(z, known) if known.any() else np.zeros(z.shape)
        return Terrain(west, south, step_m, _highest_within(z - self.zero_m, within_m / step_m + _BETWEEN_NODES))

    def window(self, bounds: BoundingBox, most_nodes: int = _DEM_WINDOW_NODES) -> KnownGround:
        """Heights over `zero_m` in the area's CRS within bounds, a node every pixel of the DEM or at most so many."""
        return _window_over(self, bounds, most_nodes)


@lru_cache(maxsize=6)
def _window_over(model: HeightModel, bounds: BoundingBox, most_nodes: int) -> KnownGround:
    ground = _window(model.path, model.epsg, bounds, most_nodes)
    t = ground.terrain
    return KnownGround(Terrain(t.west, t.south, t.step_m, t.z - np.float32(model.zero_m)), ground.known)


def _window(path: Path, epsg: int, bounds: BoundingBox, most_nodes: int) -> KnownGround:
    z, left, low, step = _on_area(Path(path), epsg, bounds, most_nodes)
    known = np.isfinite(z)
    z = _filled(z, known) if known.any() else np.zeros(z.shape)
    return KnownGround(Terrain(left, low, step, z.astype(np.float32)), known)


def _no_cover(path: Path, epsg: int, bounds: BoundingBox, cover: float) -> str:
    west, south, east, north = bounds
    return (
        f"{Path(path).name} has heights for only {100 * cover:.0f} % of the area of the flight "
        f"(EPSG:{epsg}, east {west:.0f} to {east:.0f}, north {south:.0f} to {north:.0f}); give a DEM that covers it"
    )


def _refuse_buried(path: Path, ground: Array, cameras: Array) -> None:
    """Refuse ground (N,) above cameras (N,), both over takeoff; NaN where a camera's height is not known."""
    known = np.isfinite(cameras)
    if known.any() and float((ground > cameras)[known].mean()) > _DEM_MOST_BURIED:
        raise InputError(
            f"by {Path(path).name} the ground lies above {float((ground > cameras)[known].mean()):.0%} of the cameras "
            f"(its heights below the flight span {ground.max() - ground.min():.0f} m); check that it is this area's "
            "and in metres"
        )


def _on_area(
    path: Path, epsg: int, bounds: BoundingBox, most_nodes: int, *, highest_step_m: float | None = None
) -> tuple[Array, float, float, float]:
    """Heights in metres on nodes (rows go north), NaN where unknown, with west, south and step.

    Nodes have the mean of the pixels about them; with `highest_step_m` the highest, and nodes are at most that far
    apart where their number allows it.
    """
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.vrt import WarpedVRT

    name = path.name
    if not exists(path):
        raise InputError(f"the DEM {address_of(path)} does not exist; check --dem")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            dataset = rasterio.open(local_file(path))
    except RasterioError:
        raise InputError(f"{name} is not a readable height model; give a GeoTIFF with heights by --dem") from None
    with dataset:
        if dataset.crs is None:
            raise InputError(f"{name} has no CRS; assign one (gdal_edit.py -a_srs EPSG:...) and try again")
        require_datum(dataset.crs.to_wkt(), name)
        if dataset.count > 1 and dataset.dtypes[0] == "uint8":
            raise InputError(f"{name} is a picture ({dataset.count} bands of 8 bit), not heights; give a DEM by --dem")
        try:
            west, south, east, north = bounds
            pixel = _pixel_m(dataset, epsg, bounds)
            step = _own_step(min(pixel, highest_step_m or pixel), bounds, most_nodes)
            left, low = float(np.floor(west / step) * step), float(np.floor(south / step) * step)
            columns, rows = int(np.ceil((east - left) / step)) + 1, int(np.ceil((north - low) / step)) + 1
            # a pixel about every node: its centre is the node
            transform = rasterio.Affine(step, 0.0, left - 0.5 * step, 0.0, -step, low + (rows - 0.5) * step)
            with (
                rasterio.open(_in_metres(dataset, name)) as heights,
                WarpedVRT(
                    heights,
                    src_crs=dataset.crs,
                    crs=f"EPSG:{epsg}",
                    transform=transform,
                    width=columns,
                    height=rows,
                    resampling=getattr(Resampling, _resampling(pixel / step, highest_step_m is not None)),
                    src_nodata=_VOID_M,
                    nodata=float("nan"),
                    dtype="float64",
                    add_alpha=False,
                ) as warped,
            ):
                z = warped.read(1).astype(np.float64)
        except RasterioError as error:
            raise InputError(f"{name} cannot be read as heights ({error}); check the file") from None
    return np.ascontiguousarray(z[::-1]), left, low, step


def _in_metres(dataset: Any, name: str) -> str:
    """A virtual raster (VRT) of a DEM's heights in metres in which voids, declared or not, are `_VOID_M`."""
    unit = _unit_m(str(dataset.units[0] or ""), name)
    scale, offset = float(dataset.scales[0] or 1.0), float(dataset.offsets[0] or 0.0)
    (low, first), (high, last) = sorted(((m / unit - offset) / scale, m) for m in (_LOWEST_M, _HIGHEST_M))
    below, above = float(np.nextafter(low, -np.inf)), float(np.nextafter(high, np.inf))
    table = {below: _VOID_M, low: first, high: last, above: _VOID_M}  # stored value -> metres, straight in between
    how = {} if dataset.nodata is None else {"NODATA": dataset.nodata}
    heights = virtual_band(dataset, 1, "Gray", "Float64", LUT=",".join(f"{x}:{y}" for x, y in table.items()), **how)
    ET.SubElement(heights, "NoDataValue").text = str(_VOID_M)
    root = virtual_raster(dataset)
    root[:] = [*(part for part in root if part.tag != "VRTRasterBand"), heights]
    return ET.tostring(root, "unicode")


def _unit_m(unit: str, name: str) -> float:
    """Metres of a height model's unit, in whichever case, with whatever between its words and beside them.

    Writers add the datum ("m (EGM96)", "metres above sea level"), or fill in that there is no unit.

    Raises:
        InputError: no known unit is in it, or a number that makes it another one ("0.1 m").
    """
    words = [w for w in re.findall("[a-z0-9]+", unit.lower().replace("u.s.", "us")) if w != "intl"]
    number = re.match(r"\s*([\d.,/]+)", unit)
    scaled = number is not None and re.fullmatch(r"1(?:\.0*)?", number[1]) is None
    metres = None if scaled or (unit.strip() and not words) else _unit_among(words)
    if metres is None:
        raise InputError(
            f"{name} has heights in '{unit.strip()}', which is no known unit; set it with gdal_edit.py -units m"
        )
    return metres


def _unit_among(words: list[str]) -> float | None:
    """Metres of the longest unit among words, feet before others; as metres count no unit and words for none."""
    for count in range(min(len(words), _MOST_WORDS), 0, -1):
        runs = [" ".join(words[at : at + count]) for at in range(len(words) - count + 1)]
        known = [_METRES[run] for run in runs if run in _METRES]
        if known:
            return next((metres for metres in known if metres in (0.3048, _US_FOOT_M)), known[0])
    return 1.0 if not words or _NO_UNIT & set(words) else None


def _pixel_m(dataset: Any, epsg: int, bounds: BoundingBox) -> float:
    """Side of the DEM's own pixel in metres, about the area's middle."""
    from rasterio.warp import transform

    x, y = bounds.center
    (px, pe, pn), (qx, qe, qn) = transform(f"EPSG:{epsg}", dataset.crs, [x, x + 100.0, x], [y, y, y + 100.0])
    inverse = ~dataset.transform
    a, b, c = (np.array(inverse * p) for p in ((px, qx), (pe, qe), (pn, qn)))
    area = abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])
    return 100.0 / float(np.sqrt(area)) if np.isfinite(area) and area > 0 else 1.0


def _resampling(pixel_steps: float, highest: bool) -> str:
    """GDAL's resampling of pixels whose side is so many steps of the nodes."""
    if highest and pixel_steps < _DEM_HIGHEST_STEPS:
        return "max"
    return "average" if pixel_steps < _DEM_MEAN_STEPS else "bilinear"


def _highest_within(z: Array, steps: float) -> Floats:
    """The highest of the nodes (rows, columns) up to so many steps away from each."""
    import cv2

    reach = np.arange(-int(steps), int(steps) + 1)
    disc = (np.hypot(*np.meshgrid(reach, reach)) <= steps).astype(np.uint8)
    return np.asarray(cv2.dilate(z.astype(np.float32), disc), np.float32)


def _own_step(pixel_m: float, bounds: BoundingBox, most_nodes: int) -> float:
    """Distance of nodes, metres: a pixel's side, but not finer than `_DEM_FINEST_M` and a number of nodes allow."""
    spread = float(np.sqrt(bounds.width * bounds.height / min(most_nodes, DEM_MOST_NODES)))
    return float(max(_DEM_FINEST_M, round(pixel_m, 1), spread))


def _filled(z: Array, known: Flags) -> Array:
    """Gaps filled from their surroundings: averages over growing neighbourhoods, the nearest known scale first."""
    if known.all():
        return z
    from scipy.ndimage import uniform_filter

    value, weight = np.where(known, z, 0.0), known.astype(np.float64)
    out, done = value.copy(), known.copy()
    size = 3
    while not done.all():
        w = uniform_filter(weight, size, mode="constant")
        v = uniform_filter(value, size, mode="constant")
        ready = ~done & (w > 0.5 / size**2)
        out[ready] = v[ready] / w[ready]
        done |= ready
        size = 2 * size + 1
    return out

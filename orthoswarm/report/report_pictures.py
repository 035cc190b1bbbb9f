"""Pictures of the report: windows of the products, drawings on them, and their encoding into the page."""

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.evaluation.displacement import Displacements, FieldSettings, displacement_field
from orthoswarm.model.arrays import Array, Bytes, Flags
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import MapWindow
from orthoswarm.raster.resampling import resample

Colour = tuple[int, int, int]

PAPER: Colour = (238, 240, 243)
_SUBPIXEL_BITS = 4
_MOST_RELIEF_PX = 1000
_LIGHT = np.array([-1.0, 1.0, 1.4]) / np.sqrt(1.0 + 1.0 + 1.4**2)
"""Towards the light, east, north, up: from the north-west at 45 degrees, as maps are shaded."""


@dataclass(slots=True)
class Picture:
    """Colours on the ground."""

    rgb: Bytes  # uint8 (rows, columns, 3), empty ground in the page's colour
    seen: Flags  # bool (rows, columns), where there is something
    grid: GroundGrid  # where it lies

    def on(self, grid: GroundGrid) -> "Picture":
        """Resampled to another grid, as far as it reaches."""
        bands, seen = _regrid(np.ascontiguousarray(self.rgb.transpose(2, 0, 1)), self.seen, self.grid, grid)
        return on_paper(bands.transpose(1, 2, 0).copy(), seen, grid)


def _regrid(bands: Bytes, valid: Flags, old: GroundGrid, new: GroundGrid) -> tuple[Bytes, Flags]:
    first = ((new.west - old.west) / old.gsd_m, (old.north - new.north) / old.gsd_m)
    scale = new.gsd_m / old.gsd_m
    return resample(bands, valid, first, (scale, scale), (new.width, new.height))


def view_grid(epsg: int, bounds: BoundingBox, most_px: int, least_gsd_m: float = 0.0) -> GroundGrid:
    """A grid of at most so many pixels a side over bounds, no finer than a ground pixel."""
    side = max(bounds.width, bounds.height)
    return GroundGrid.around(epsg, bounds, max(side / (most_px - 2), least_gsd_m, 1e-3))


def product_bounds(path: Path) -> BoundingBox:
    """West, south, east, north of what is drawn in a product."""
    import rasterio

    with rasterio.open(path) as source:
        shrink = max(1.0, max(source.width, source.height) / 512)
        shape = (max(1, int(source.height / shrink)), max(1, int(source.width / shrink)))
        alpha = source.read(4, out_shape=shape)
        rows, cols = np.nonzero(alpha.any(axis=1))[0], np.nonzero(alpha.any(axis=0))[0]
        if not len(rows):
            return BoundingBox(*source.bounds)
        left, top = source.bounds.left, source.bounds.top
        dx, dy = (source.bounds.right - left) / shape[1], (top - source.bounds.bottom) / shape[0]
        return BoundingBox(
            left + float(cols[0]) * dx,
            top - float(rows[-1] + 1) * dy,
            left + float(cols[-1] + 1) * dx,
            top - float(rows[0]) * dy,
        )


def product_picture(path: Path, grid: GroundGrid) -> Picture:
    """A product on a grid (to half a pixel: for looking at)."""
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    rgba = np.zeros((4, grid.height, grid.width), np.uint8)
    with rasterio.open(path) as source:
        step = source.res[0]
        left, top = (grid.west - source.bounds.left) / step, (source.bounds.top - grid.north) / step
        scale = grid.gsd_m / step
        # Whole pixels of the answer that lie within the product.
        c0, c1 = max(0, round(-left / scale)), min(grid.width, round((source.width - left) / scale))
        r0, r1 = max(0, round(-top / scale)), min(grid.height, round((source.height - top) / scale))
        if c0 < c1 and r0 < r1:
            x0, y0 = max(0.0, left + c0 * scale), max(0.0, top + r0 * scale)
            x1, y1 = min(source.width, left + c1 * scale), min(source.height, top + r1 * scale)
            how = Resampling.average if scale > 1 else Resampling.bilinear
            shape, window = (4, r1 - r0, c1 - c0), Window(x0, y0, x1 - x0, y1 - y0)
            rgba[:, r0:r1, c0:c1] = source.read(window=window, out_shape=shape, resampling=how)
    return on_paper(rgba[:3].transpose(1, 2, 0).copy(), rgba[3] > 127, grid)


@dataclass(frozen=True, slots=True)
class MapView:
    """The map in grey on a grid: uint8 (rows, columns), and where it means something."""

    gray: Bytes
    valid: Flags
    grid: GroundGrid

    @classmethod
    def read(cls, basemap: MapWindow, grid: GroundGrid) -> "MapView":
        """Read a window of a map."""
        gray, valid = basemap.gray(grid.bounds, grid.gsd_m)
        full = GroundGrid.around(grid.epsg, grid.bounds, grid.gsd_m)
        return cls(np.clip(gray + 0.5, 0, 255).astype(np.uint8), valid, full).on(grid)

    def on(self, grid: GroundGrid) -> "MapView":
        """Resampled to another grid, as far as it reaches."""
        gray, valid = _regrid(self.gray[None], self.valid, self.grid, grid)
        return MapView(gray[0], valid, grid)

    def picture(self) -> Picture:
        """To draw on."""
        return on_paper(np.repeat(self.gray[..., None], 3, axis=2), self.valid, self.grid)


def on_paper(rgb: Bytes, seen: Flags, grid: GroundGrid) -> Picture:
    """A picture whose empty ground has the page's colour; its array must be in order (OpenCV draws in no other)."""
    rgb[~seen] = PAPER
    return Picture(rgb, seen, grid)


def pale(picture: Picture, share: float = 0.55) -> Picture:
    """A grey, light version to draw on."""
    import cv2

    gray = cv2.cvtColor(picture.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    light = (255.0 - share * (255.0 - gray)).astype(np.uint8)
    return on_paper(np.repeat(light[..., None], 3, axis=2), picture.seen, picture.grid)


def draw_lines(
    picture: Picture, lines: Sequence[Array], colour: Colour, width: int = 1, *, closed: bool = False
) -> None:
    """Draw ground polylines, float64 (K, 2) each."""
    import cv2

    points = [_pixels(picture.grid, line) for line in lines if len(line) > 1]
    cv2.polylines(picture.rgb, points, closed, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def fill_polygons(picture: Picture, polygons: Sequence[Array], colour: Colour, opacity: float) -> None:
    """Tint the ground inside polygons, more where several lie over each other."""
    import cv2

    layer = np.zeros(picture.rgb.shape[:2], np.float32)
    for polygon in polygons:
        one = np.zeros(picture.rgb.shape[:2], np.uint8)
        cv2.fillPoly(one, [_pixels(picture.grid, polygon)], 1, cv2.LINE_8, _SUBPIXEL_BITS)
        layer += one
    weight = (1.0 - (1.0 - opacity) ** layer)[..., None]
    picture.rgb[:] = (picture.rgb * (1 - weight) + np.array(colour, np.float32) * weight).astype(np.uint8)


def draw_arrows(picture: Picture, start: Array, end: Array, colour: Colour) -> None:
    """Draw arrows between ground points (K, 2), with a dot where each begins."""
    import cv2

    for a, b in zip(picture.grid.to_pixel(start), picture.grid.to_pixel(end), strict=True):
        first, last = (int(a[0]), int(a[1])), (int(b[0]), int(b[1]))
        cv2.circle(picture.rgb, first, 2, colour, -1, cv2.LINE_AA)
        length = max(1.0, float(np.hypot(*(b - a))))
        cv2.arrowedLine(picture.rgb, first, last, colour, 1, cv2.LINE_AA, 0, min(0.4, 5.0 / length))


def scale_bar(picture: Picture) -> None:
    """A bar of a round length in the lower left corner."""
    import cv2

    grid = picture.grid
    wanted = 0.25 * grid.width * grid.gsd_m
    unit = 10.0 ** np.floor(np.log10(wanted))
    metres = float(max(s for s in (1, 2, 5) if s * unit <= wanted) * unit)
    length = round(metres / grid.gsd_m)
    x, y = 12, grid.height - 14
    text = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
    cv2.rectangle(picture.rgb, (x - 6, y - 22), (x + max(length, 44) + 6, y + 6), (255, 255, 255), -1)
    cv2.line(picture.rgb, (x, y), (x + length, y), (20, 24, 30), 2)
    cv2.putText(picture.rgb, text, (x, y - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20, 24, 30), 1, cv2.LINE_AA)


def map_edges(view: MapView) -> Flags:
    """Strong edges of a map, the upper part of its own gradients."""
    import cv2

    smooth = cv2.GaussianBlur(view.gray, (0, 0), 1.0)
    gx, gy = cv2.Sobel(smooth, cv2.CV_16S, 1, 0), cv2.Sobel(smooth, cv2.CV_16S, 0, 1)
    inside = cv2.erode(view.valid.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    size = np.hypot(gx, gy, dtype=np.float32)
    if not inside.any():
        return np.zeros(view.gray.shape, bool)
    high = float(np.percentile(size[inside], 92))
    edges = np.asarray(cv2.Canny(gx, gy, 0.4 * high, max(high, 1.0), L2gradient=True), np.uint8)
    return np.asarray((edges > 0) & inside)


def relief(height_m: NDArray[np.floating[Any]], cell_m: float) -> Bytes:
    """Shaded relief, uint8 (rows, columns, 3), of heights (rows, columns; rows go south); NaN in the page's colour."""
    z = np.asarray(height_m, np.float64)
    south, east = np.gradient(z, cell_m)
    light = (-_LIGHT[0] * east + _LIGHT[1] * south + _LIGHT[2]) / np.sqrt(1.0 + east**2 + south**2)
    known = np.isfinite(light)
    grey = np.clip(40.0 + 215.0 * np.where(known, light, 0.0), 0, 255).astype(np.uint8)
    return np.where(known[..., None], grey[..., None], np.array(PAPER, np.uint8)).astype(np.uint8)


def surface_picture(surface: Mapping[str, Any]) -> tuple[Bytes, str]:
    """The picture of a surface model, and what it shows. surface: `surface` of report.json."""
    import rasterio
    from rasterio.enums import Resampling

    with rasterio.open(Path(surface["file"])) as file:
        step = max(1, -(-max(file.height, file.width) // _MOST_RELIEF_PX))
        shape = (max(2, file.height // step), max(2, file.width // step))
        height = file.read(1, out_shape=shape, masked=True, resampling=Resampling.nearest)
        cell_m = file.res[0] * file.height / shape[0]
    z = np.ma.filled(height.astype(np.float64), np.nan)
    common = surface.get("common_sigma_m")
    zero = "the takeoff level" if surface["takeoff_altitude_m"] is None else "the zero of the receivers' altitudes"
    low, high = np.nanquantile(z, [0.01, 0.99]) if np.isfinite(z).any() else (np.nan, np.nan)
    text = (
        f"Shaded heights of ground, roofs and crowns, from {low:.0f} to {high:.0f} m above {zero} (98 % of the cells); "
        f"cells of {surface['cell_m']:.2f} m. Usual sigma {surface['median_sigma_m'] or np.nan:.2f} m against the "
        f"heights around{'' if common is None else f', and {common:.1f} m that all heights have in common'}. Empty: "
        "fewer than two pairs of photos agree."
    )
    return relief(z, cell_m), text


def data_uri(rgb: Bytes, quality: int = 82) -> str:
    """A picture as a JPEG inside the page."""
    import simplejpeg

    data = simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=quality, colorspace="RGB", colorsubsampling="420")
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")


def _pixels(grid: GroundGrid, points: Array) -> Any:
    return np.round(np.clip(grid.to_pixel(points), -1e5, 1e5) * 2**_SUBPIXEL_BITS).astype(np.int32)


# -- how far blocks of the orthoimage lie from the map -----------------------------------------------------------------


_BLOCK_PX: Final = 64  # side of a block
_SEARCH_PX: Final = 15  # how far it is searched
_APART_PX: Final = 6  # correlations within this distance, pixels, belong to the same peak
_MOST_BLOCKS: Final = 500  # most blocks of a map (for its time)
_LEAST_COVER: Final = 0.9  # least share of a block and of its search area that is drawn
_LEAST_PEAK: Final = 0.4  # least correlation: chance likeness reaches 0.3 (measured on simulated disasters)
_BAND_PX: Final = 500_000  # pixels that are compared at once (memory: gradients take a hundred bytes a pixel)


@dataclass(frozen=True, slots=True)
class Moved:
    """Where blocks of the map are found in the orthoimage."""

    at: Array  # float64 (K, 2), places in the orthoimage, on the ground
    shift: Array  # float64 (K, 2), from there to the same thing in the map, metres
    blocks: int  # how many blocks were tried

    @classmethod
    def joined(cls, parts: "Sequence[Moved]") -> "Moved":
        """What several parts of the map show, together."""
        at, shift = ([np.zeros((0, 2)), *(getattr(p, name) for p in parts)] for name in ("at", "shift"))
        return cls(np.concatenate(at), np.concatenate(shift), sum(p.blocks for p in parts))

    @property
    def size_m(self) -> Array:
        """Lengths of the shifts, metres."""
        return np.asarray(np.hypot(self.shift[:, 0], self.shift[:, 1]))


def moved(ortho: Bytes, seen: Flags, basemap: Bytes, valid: Flags, grid: GroundGrid) -> Moved:
    """Match a map to an orthoimage of the same grid, at up to some hundred places.

    Only clear matches count. What changed between the two (debris, other seasons) therefore gives no arrow, rather
    than a wrong one.

    Args:
        ortho: grey orthoimage (rows, columns). seen: where it is drawn. basemap: grey map on the same grid.
        valid: where the map means something. grid: of both.
    """
    step = max(_BLOCK_PX, float(np.sqrt(seen.sum() / _MOST_BLOCKS)))
    settings = FieldSettings(
        gsd_m=grid.gsd_m, block_m=_BLOCK_PX * grid.gsd_m, step_m=step * grid.gsd_m, search_m=_SEARCH_PX * grid.gsd_m,
        apart_m=_APART_PX * grid.gsd_m, min_cover=_LEAST_COVER, min_peak=_LEAST_PEAK,
    )  # fmt: skip
    field = Displacements.joined(list(_fields(ortho, seen, basemap, valid, settings)))
    found = field.matched
    shift = field.shift_m[found]
    return Moved(grid.to_ground(field.position[found]) + shift, -shift, len(found))


def _fields(
    ortho: Bytes, seen: Flags, basemap: Bytes, valid: Flags, settings: FieldSettings
) -> Iterator[Displacements]:
    """The field in bands of whole rows of blocks: gradients take a hundred bytes a pixel."""
    side, step, reach = (
        max(1, round(length / settings.gsd_m)) for length in (settings.block_m, settings.step_m, settings.search_m)
    )
    wide_ortho, wide_seen = np.pad(ortho, reach), np.pad(seen, reach)
    rows, columns = basemap.shape
    at_once = step * max(1, _BAND_PX // columns // step)
    for top in range(0, rows - side + 1, at_once):
        last = min(top + at_once, rows - side + 1) - 1
        end = last // step * step + side
        around = slice(top, end + 2 * reach)
        yield displacement_field(
            wide_ortho[around].astype(np.float32), wide_seen[around], basemap[top:end].astype(np.float32),
            valid[top:end], settings=settings, offset=(top, 0),
        )  # fmt: skip

"""KMZ: the orthoimage for globes and tactical maps; one ground overlay if it is small, else a pyramid of them.

The pyramid is KML's "super-overlay": each node is shown while it is small on the screen and names its four children.
"""

import zipfile
from collections.abc import Callable
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.atomic_file import written_whole
from orthoswarm.export.mbtiles import encode_tile
from orthoswarm.export.reduced_raster import ReducedRaster
from orthoswarm.model.errors import InputError

Bytes = NDArray[np.uint8]
_SINGLE_PX = 2048
_TILE_PX = 512


def write_kmz(
    source: Path, path: Path, *, name: str = "orthoimage", progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a georeferenced RGBA raster as KMZ.

    Args:
        source: the raster, an orthoimage.
        path: the file; appears when it is complete.
        name: shown by viewers.
        progress: called with tiles done and tiles in all.

    Raises:
        InputError: if the raster cannot be read.
        OrthoSwarmError: if the disk is full.
    """
    from rasterio.errors import RasterioError
    from rasterio.warp import calculate_default_transform

    try:
        with ReducedRaster(source) as reduced, written_whole(path) as part:
            raster = reduced.full
            # Latitude and longitude with pixels that are square on the ground keep the overlay's proportions.
            transform, width, height = calculate_default_transform(
                raster.crs, "EPSG:4326", raster.width, raster.height, *raster.bounds
            )
            north, west = transform.f, transform.c
            box = (west, north + transform.e * height, west + transform.a * width, north)
            with zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
                _Pyramid(
                    raster=reduced, archive=archive, box=box, width=width, height=height, name=name, progress=progress
                ).write()
    except RasterioError as error:
        raise InputError(f"{source} cannot be read ({error}); make the map again") from None


class _Pyramid:
    """One archive: tiles by level (0 has all in one tile), row and column."""

    def __init__(
        self,
        raster: ReducedRaster,
        archive: zipfile.ZipFile,
        *,
        box: tuple[float, float, float, float],
        width: int,
        height: int,
        name: str,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.raster, self.archive, self.box, self.name, self.progress = raster, archive, box, name, progress
        self.width, self.height = width, height
        self.depth = 0
        if max(width, height) > _SINGLE_PX:
            while _TILE_PX << self.depth < max(width, height):
                self.depth += 1
        self.done = 0
        self.total = sum(len(self._nodes(level)) for level in range(self.depth + 1))

    def write(self) -> None:
        if self.depth == 0:
            data, _ = self._picture(0, 0, 0, max(self.width, self.height))
            overlay = _overlay(self.name, "overlay.png", self.box, 0)
            self.archive.writestr("doc.kml", _document(self.name, overlay))
            self.archive.writestr("overlay.png", data or b"")
            self._tell()
            return
        root = _network_link("0/0/0.kml", self.box)
        self.archive.writestr("doc.kml", _document(self.name, root))
        for level in range(self.depth + 1):
            for row, col in self._nodes(level):
                self._node(level, row, col)
                self._tell()

    def _nodes(self, level: int) -> list[tuple[int, int]]:
        span = _TILE_PX << (self.depth - level)  # raster pixels a node is wide
        rows, cols = -(-self.height // span), -(-self.width // span)
        return [(r, c) for r in range(rows) for c in range(cols)]

    def _node(self, level: int, row: int, col: int) -> None:
        """One node: its picture, and links to its children."""
        data, box = self._picture(level, row, col, _TILE_PX)
        parts = []
        if data is not None:
            image = f"{col}.png" if data[:4] == b"\x89PNG" else f"{col}.jpg"
            self.archive.writestr(f"{level}/{row}/{image}", data)
            parts.append(_overlay("", image, box, level))
        children = set(self._nodes(level + 1)) if level < self.depth else set()
        for child in ((2 * row + i, 2 * col + j) for i in (0, 1) for j in (0, 1)):
            if child in children:
                link = f"../../{level + 1}/{child[0]}/{child[1]}.kml"
                parts.append(_network_link(link, self._box(level + 1, *child)))
        region = _region(box, 128, -1 if level == self.depth else 1024)
        self.archive.writestr(f"{level}/{row}/{col}.kml", _document("", region + "".join(parts)))

    def _box(self, level: int, row: int, col: int) -> tuple[float, float, float, float]:
        span = _TILE_PX << (self.depth - level)
        west, south, east, north = self.box
        dx, dy = (east - west) / self.width, (north - south) / self.height
        right, bottom = min((col + 1) * span, self.width), min((row + 1) * span, self.height)
        return west + col * span * dx, north - bottom * dy, west + right * dx, north - row * span * dy

    def _picture(
        self, level: int, row: int, col: int, side: int
    ) -> tuple[bytes | None, tuple[float, float, float, float]]:
        """A node's picture, None where it is empty, and its box."""
        from rasterio.enums import Resampling
        from rasterio.transform import from_bounds
        from rasterio.vrt import WarpedVRT

        box = self.box if self.depth == 0 else self._box(level, row, col)
        factor = 1 << (self.depth - level)
        span = side * factor
        width = max(1, (min((col + 1) * span, self.width) - col * span) // factor)
        height = max(1, (min((row + 1) * span, self.height) - row * span) // factor)
        source, left = self.raster.at(factor)
        with WarpedVRT(
            source,
            crs="EPSG:4326",
            transform=from_bounds(*box, width, height),
            width=width,
            height=height,
            resampling=Resampling.average if left > 1 else Resampling.bilinear,
            warp_mem_limit=64,
        ) as vrt:
            rgba = np.ascontiguousarray(vrt.read().transpose(1, 2, 0))
        if not rgba[..., 3].any():
            return None, box
        opaque = bool((rgba[..., 3] == 255).all()) and self.depth > 0
        return encode_tile(rgba, "jpg" if opaque else "png"), box

    def _tell(self) -> None:
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.total)


def _document(name: str, content: str) -> str:
    title = f"<name>{escape(name)}</name>" if name else ""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
        f"{title}{content}</Document></kml>\n"
    )


def _overlay(name: str, image: str, box: tuple[float, float, float, float], order: int) -> str:
    west, south, east, north = box
    title = f"<name>{escape(name)}</name>" if name else ""
    return (
        f"<GroundOverlay>{title}<drawOrder>{order}</drawOrder><Icon><href>{image}</href></Icon><LatLonBox>"
        f"<north>{north:.9f}</north><south>{south:.9f}</south><east>{east:.9f}</east><west>{west:.9f}</west>"
        "</LatLonBox></GroundOverlay>"
    )


def _region(box: tuple[float, float, float, float], least: int, most: int) -> str:
    west, south, east, north = box
    return (
        f"<Region><LatLonAltBox><north>{north:.9f}</north><south>{south:.9f}</south><east>{east:.9f}</east>"
        f"<west>{west:.9f}</west></LatLonAltBox><Lod><minLodPixels>{least}</minLodPixels>"
        f"<maxLodPixels>{most}</maxLodPixels></Lod></Region>"
    )


def _network_link(href: str, box: tuple[float, float, float, float]) -> str:
    return (
        f"<NetworkLink>{_region(box, 128, -1)}<Link><href>{href}</href>"
        "<viewRefreshMode>onRegion</viewRefreshMode></Link></NetworkLink>"
    )

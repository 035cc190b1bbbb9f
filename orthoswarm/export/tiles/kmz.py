"""KMZ: the orthoimage for globes and tactical maps; one ground overlay if it is small, else a pyramid of them.

The pyramid is KML's "super-overlay": each node is shown while it is small on the screen and names its children. Nodes
are quads of web map tiles. KML stretches an overlay evenly over latitude, web mercator does not: over a node of 512
pixels of a map of 10 km that is less than a tenth of a pixel.
"""

import contextlib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.tiles.mbtiles import encode_tile
from orthoswarm.export.tiles.tile_pyramid import SIDE, Pyramid, Quad, degrees_of, draw_tiles
from orthoswarm.export.xml_elements import element, kml_bytes, texts
from orthoswarm.model.arrays import Bytes

Box = tuple[float, float, float, float]  # west, south, east, north in degrees
_SINGLE_PX = 2048
_TOP_NODES = 4  # A map that lies across a tile's border has no node of its own size; so up to four are at the top


def write_kmz(
    source: Path, path: Path, *, name: str = "orthoimage", progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a georeferenced RGBA raster as KMZ.

    Args:
        source: the raster, an orthoimage. path: the file; appears when it is complete. name: shown by viewers.
        progress: called with parts done and parts in all.

    Raises:
        InputError: if the raster cannot be read.
        OrthoSwarmError: if the disk is full, or the raster shows nothing.
    """
    with kmz_file(path, name) as file:
        draw_tiles(source, [file], progress)


@contextlib.contextmanager
def kmz_file(path: Path, name: str = "orthoimage") -> "Iterator[KmzFile]":
    """A KMZ file to fill by `draw_tiles`; see `write_kmz`. It appears when the block ends without an error."""
    with atomic_write(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
        yield KmzFile(archive, name)


class KmzFile:
    """An open KMZ file. See `tile_pyramid.TileFile`."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self._archive, self._name = archive, name
        self._images: dict[tuple[int, int, int], str] = {}
        self._single: Bytes | None = None

    def begin(self, pyramid: Pyramid) -> None:
        """Write the root of a pyramid first, as readers expect it; a small picture is gathered in memory."""
        self._pyramid = pyramid
        self._finest = pyramid.finest.zoom - 1
        self._top = next((k for k in pyramid.levels[1:] if k.count <= _TOP_NODES), pyramid.finest)
        left, top, right, bottom = pyramid.pixels()
        if max(right - left, bottom - top) <= _SINGLE_PX:
            tiles = pyramid.finest
            sides = (tiles.bottom // 2 - tiles.top // 2 + 1, tiles.right // 2 - tiles.left // 2 + 1)
            self._single = np.zeros((sides[0] * 2 * SIDE, sides[1] * 2 * SIDE, 4), np.uint8)
        else:
            nodes = [(self._top.zoom, x, y) for x, y in self._top.tiles()]
            links = [_network_link("{}/{}/{}.kml".format(*self._node(*node)), _box(*node)) for node in nodes]
            self._archive.writestr("doc.kml", kml_bytes(*texts(name=self._name), *links))

    def encode(self, quad: Quad) -> bytes | None:
        """The picture of a node; None if the quad is none."""
        if self._single is not None or quad.zoom < self._top.zoom:
            return None
        return encode_tile(quad.rgba, "jpg" if bool((quad.rgba[..., 3] == 255).all()) else "png")

    def store(self, quad: Quad, encoded: bytes | None) -> None:
        """Write a node's picture."""
        if self._single is not None and quad.zoom == self._finest:
            row, col = quad.y - self._pyramid.finest.top // 2, quad.x - self._pyramid.finest.left // 2
            side = 2 * SIDE
            self._single[row * side : (row + 1) * side, col * side : (col + 1) * side] = quad.rgba
        elif encoded is not None:
            level, row, col = self._node(quad.zoom, quad.x, quad.y)
            image = f"{col}.png" if encoded[:4] == b"\x89PNG" else f"{col}.jpg"
            self._archive.writestr(f"{level}/{row}/{image}", encoded)
            self._images[quad.zoom, quad.x, quad.y] = image

    def end(self) -> None:
        """Write the single picture, or the nodes, which link to those of their children that show something."""
        if self._single is not None:
            self._write_single(self._single)
            return
        empty = dict.fromkeys((self._top.zoom, x, y) for x, y in self._top.tiles())  # doc.kml links to all of these
        for (zoom, x, y), image in (empty | self._images).items():
            level, row, col = self._node(zoom, x, y)
            box = _box(zoom, x, y)
            parts = [_region(box, 128, -1 if zoom == self._finest else 1024)]
            parts += [_overlay("", image, box, level)] if image else []
            for child in ((zoom + 1, 2 * x + j, 2 * y + i) for i in (0, 1) for j in (0, 1)):
                if child in self._images:
                    below = self._node(*child)
                    parts.append(_network_link(f"../../{below[0]}/{below[1]}/{below[2]}.kml", _box(*child)))
            self._archive.writestr(f"{level}/{row}/{col}.kml", kml_bytes(*parts))

    def _node(self, zoom: int, x: int, y: int) -> tuple[int, int, int]:
        """Level (0 is the coarsest), row and column of a node, counted from the first of its level."""
        level = zoom - self._top.zoom
        return level, y - (self._top.top << level), x - (self._top.left << level)

    def _write_single(self, rgba: Bytes) -> None:
        left, top, right, bottom = self._pyramid.pixels()
        aside, above = self._pyramid.finest.left % 2 * SIDE, self._pyramid.finest.top % 2 * SIDE
        shown = rgba[above + top : above + bottom, aside + left : aside + right]
        west, south, east, north = self._pyramid.whole_pixel_bounds()
        pictures = {"overlay.png": (shown, (west, south, east, north))}
        if self._pyramid.crosses:  # an overlay on either side: not all viewers draw one beyond 180 degrees
            side = (2**self._pyramid.finest.zoom - self._pyramid.finest.left) * SIDE - left
            pictures = {
                "overlay.png": (shown[:, :side], (west, south, 180.0, north)),
                "overlay-east.png": (shown[:, side:], (-180.0, south, east - 360.0, north)),
            }
        overlays = [_overlay(self._name, image, box, 0) for image, (_, box) in pictures.items()]
        self._archive.writestr("doc.kml", kml_bytes(*texts(name=self._name), *overlays))
        for image, (part, _) in pictures.items():
            self._archive.writestr(image, encode_tile(np.ascontiguousarray(part), "png"))


def _box(zoom: int, x: int, y: int) -> Box:
    """Place of a node; its column may be one beyond 180 degrees, its longitudes are not."""
    column = x % 2**zoom
    (west, north), (east, south) = degrees_of(column, y, zoom), degrees_of(column + 1, y + 1, zoom)
    return west, south, east, north


def _overlay(name: str, image: str, box: Box, order: int) -> Element:
    return element(
        "GroundOverlay", *texts(name=name, drawOrder=str(order)), element("Icon", *texts(href=image)),
        _sides("LatLonBox", box),
    )  # fmt: skip


def _region(box: Box, least: int, most: int) -> Element:
    lod = element("Lod", *texts(minLodPixels=str(least), maxLodPixels=str(most)))
    return element("Region", _sides("LatLonAltBox", box), lod)


def _sides(tag: str, box: Box) -> Element:
    west, south, east, north = (f"{v:.9f}" for v in box)
    return element(tag, *texts(north=north, south=south, east=east, west=west))


def _network_link(href: str, box: Box) -> Element:
    link = element("Link", *texts(href=href, viewRefreshMode="onRegion"))
    return element("NetworkLink", _region(box, 128, -1), link)

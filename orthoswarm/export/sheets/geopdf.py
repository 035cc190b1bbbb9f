"""A sheet to print, and to load as a map: GeoPDF (ISO 32000) of A3 with grid, scale, legend and accuracy."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.sheets.stac_item import time_span
from orthoswarm.export.sheets.stated_accuracy import stated_accuracy
from orthoswarm.export.tactical.places import Place
from orthoswarm.export.tiles.tile_pyramid import ReducedRaster
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.geo import LocalGrid

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

_DPI: Final = 200
_MM: Final = _DPI / 25.4
_A3_MM: Final = (420.0, 297.0)
_MARGIN_MM: Final = 14.0
_FOOT_MM: Final = 46.0
_SCALES: Final = tuple(int(m * 10**k) for k in range(2, 6) for m in (1, 1.5, 2, 2.5, 3, 4, 5, 7.5))
_STEPS_M: Final = tuple(m * 10**k for k in range(5) for m in (1, 2, 5))
_STEP_MM: Final = 30.0
_MOST_LINES: Final = 3  # of the statement on accuracy: so many leave room for the scale bar above the page's edge
_INK, _GRID, _MARK = (20, 24, 28), (28, 100, 176), (214, 64, 159)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Frame:
    """The map's frame on the page."""

    page: tuple[int, int]  # width and height of the page in pixels
    box: tuple[int, int, int, int]  # left, top, right, bottom of the frame in pixels
    scale: int  # denominator
    west: float  # grid metres of the frame's upper left corner
    north: float  # grid metres of the frame's upper left corner
    metres: float  # of a pixel

    def pixel(self, east_m: float, north_m: float) -> tuple[float, float]:
        """Column and row on the page."""
        return self.box[0] + (east_m - self.west) / self.metres, self.box[1] + (self.north - north_m) / self.metres


def write_geopdf(cog: Path, path: Path, places: Sequence[Place] = (), title: str = "Orthoimage") -> str:
    """Write an orthoimage as one sheet of A3 at the greatest round scale at which it fits.

    Returns the letters of title and finds that no font here has, and that are boxes on the sheet.

    Args:
        cog: the orthoimage, in a projected system in metres; `report.json` and `frames.jsonl` beside it give accuracy
            and time. path: the PDF. places: finds to mark. title: of the sheet.

    Raises:
        InputError: the COG cannot be read.
        OrthoSwarmError: the disk is full, or the PDF cannot be written.
    """
    from rasterio.enums import Resampling
    from rasterio.errors import RasterioError
    from rasterio.transform import from_origin
    from rasterio.vrt import WarpedVRT

    try:
        with ReducedRaster(cog) as reduced:
            raster = reduced.full
            frame, epsg = _frame(_drawn(raster)), int(raster.crs.to_epsg())
            left, top, right, bottom = frame.box
            transform = from_origin(frame.west, frame.north, frame.metres, frame.metres)
            with WarpedVRT(
                reduced.at(0.5 * frame.metres / raster.res[0])[0],
                transform=transform,
                width=right - left,
                height=bottom - top,
                resampling=Resampling.average,
            ) as vrt:
                rgba = vrt.read().transpose(1, 2, 0)
    except RasterioError as error:
        raise InputError(f"{cog} cannot be read ({error}); make the map again") from None
    page = _page(frame, rgba, epsg, cog=cog, places=places, title=title)
    with atomic_write(path) as part:
        _save(page, frame, epsg, part, title)
    names = {title, *(place.name for place in places if place.kind == "find")}
    return "".join(sorted({letter for name in names for letter in _font_file(name)[1]}))


def _drawn(raster: Any) -> BoundingBox:
    """Grid bounds of what is drawn, to a 512th of the raster."""
    factor = max(1, max(raster.shape) // 512)
    shape = math.ceil(raster.height / factor), math.ceil(raster.width / factor)
    rows, cols = np.nonzero(raster.dataset_mask(out_shape=shape))
    west, south, east, north = raster.bounds
    if not len(rows):
        return BoundingBox(west, south, east, north)
    x, y = (east - west) / shape[1], (north - south) / shape[0]
    return BoundingBox(
        west + x * cols.min(), north - y * (rows.max() + 1), west + x * (cols.max() + 1), north - y * rows.min()
    )


def _frame(bounds: BoundingBox) -> _Frame:
    """The page upright or lying, whichever shows the map larger."""
    return min((_frame_on(bounds, *size_mm) for size_mm in (_A3_MM, _A3_MM[::-1])), key=lambda frame: frame.scale)


def _frame_on(bounds: BoundingBox, width_mm: float, height_mm: float) -> _Frame:
    """The map in the middle of a page of this size, at the greatest round scale at which it fits."""
    room = width_mm - 2 * _MARGIN_MM, height_mm - 2 * _MARGIN_MM - _FOOT_MM
    need = 1000.0 * max(bounds.width / room[0], bounds.height / room[1])
    scale = next((s for s in _SCALES if s >= need), math.ceil(need))
    metres = scale * 0.0254 / _DPI
    edges_mm = (_MARGIN_MM, _MARGIN_MM, _MARGIN_MM + room[0], _MARGIN_MM + room[1])
    left, top, right, bottom = (round(v * _MM) for v in edges_mm)
    return _Frame(
        page=(round(width_mm * _MM), round(height_mm * _MM)), box=(left, top, right, bottom), scale=scale,
        west=0.5 * (bounds.west + bounds.east) - 0.5 * (right - left) * metres,
        north=0.5 * (bounds.north + bounds.south) + 0.5 * (bottom - top) * metres, metres=metres,
    )  # fmt: skip


def _page(frame: _Frame, rgba: Any, epsg: int, *, cog: Path, places: Sequence[Place], title: str) -> Any:
    from PIL import Image, ImageDraw

    sheet = Image.new("RGB", frame.page, "white")
    picture = Image.fromarray(np.ascontiguousarray(rgba))
    sheet.paste(picture.convert("RGB"), frame.box[:2], picture.getchannel("A"))
    draw = ImageDraw.Draw(sheet)
    grid = LocalGrid(epsg)
    step = _grid(draw, frame)
    finds = [place for place in places if place.kind == "find"]
    for place in finds:
        east, north = (float(v) for v in grid.to_grid(place.lat_deg, place.lon_deg))
        _mark(draw, frame.pixel(east, north), place.name, frame)
    draw.rectangle(frame.box, outline=_INK, width=3)
    _foot(draw, frame, grid, cog=cog, finds=len(finds), step=step, title=title)
    return sheet


def _grid(draw: "ImageDraw", frame: _Frame) -> float:
    """Grid lines with their numbers outside the frame; gives their distance in metres."""
    left, top, right, bottom = frame.box
    step = next((s for s in _STEPS_M if s / frame.metres / _MM >= _STEP_MM), _STEPS_M[-1])
    font = _font(2.6)
    for k in range(math.ceil(frame.west / step), math.floor((frame.west + (right - left) * frame.metres) / step) + 1):
        x = frame.pixel(k * step, 0.0)[0]
        draw.line((x, top, x, bottom), fill=_GRID, width=1)
        draw.text((x, top - 6), f"{k * step % 100_000:05.0f}", fill=_INK, font=font, anchor="mb")
    south = frame.north - (bottom - top) * frame.metres
    for k in range(math.ceil(south / step), math.floor(frame.north / step) + 1):
        y = frame.pixel(0.0, k * step)[1]
        draw.line((left, y, right, y), fill=_GRID, width=1)
        draw.text((left - 6, y), f"{k * step % 100_000:05.0f}", fill=_INK, font=font, anchor="rm")
    return float(step)


def _mark(draw: "ImageDraw", at: tuple[float, float], name: str, frame: _Frame) -> None:
    x, y = at
    left, top, right, bottom = frame.box
    if left <= x <= right and top <= y <= bottom:
        size = 2.2 * _MM
        draw.ellipse((x - size, y - size, x + size, y + size), outline=_MARK, width=5)
        font = _font(3.2, name)
        draw.text((x + 1.4 * size, y), name[:60], _MARK, font, "lm", stroke_width=3, stroke_fill="white")


def _foot(draw: "ImageDraw", frame: _Frame, grid: LocalGrid, *, cog: Path, finds: int, step: float, title: str) -> None:
    left, _, right, bottom = frame.box
    lat, lon = (float(v) for v in grid.to_geographic([frame.west, frame.north]))
    zone = utm_zone(grid.epsg)
    where = f"EPSG:{grid.epsg}"
    if zone is not None:
        where = (
            f"MGRS {grid_zone(zone, lat)} {square(zone, frame.west, frame.north)}, UTM zone {zone} (EPSG:{grid.epsg})"
        )
    span = time_span(cog.parent)
    taken = f"pictures of {span}" if span else "time of the pictures is not known"
    stated = stated_accuracy(cog.parent, cog.stem)
    lines = [
        f"Scale 1:{frame.scale:,} on A3; grid lines every {step:g} m, WGS 84, {where}; up is grid north",
        f"Upper left corner {_degrees(lat, 'NS')}, {_degrees(lon, 'EW')}; {taken}",
        *_wrapped(stated.sentence if stated else "There is no report that states the accuracy.", right - left),
    ]
    y = bottom + 4.0 * _MM
    draw.text((left, y), title[:80], fill=_INK, font=_font(6.0, title))
    for k, line in enumerate(lines):
        draw.text((left, y + (9.0 + 5.0 * k) * _MM), line, fill=_INK, font=_font(3.0))
    y += (12.0 + 5.0 * len(lines)) * _MM
    _scale_bar(draw, frame, left, y)
    x = right - 90.0 * _MM
    draw.line((x, y, x + 8 * _MM, y), fill=_GRID, width=2)
    draw.text((x + 10 * _MM, y), f"grid, {step:g} m", fill=_INK, font=_font(3.0), anchor="lm")
    if finds:
        draw.ellipse((x + 2 * _MM, y + 3 * _MM, x + 6 * _MM, y + 7 * _MM), outline=_MARK, width=5)
        draw.text((x + 10 * _MM, y + 5 * _MM), f"find ({finds})", fill=_INK, font=_font(3.0), anchor="lm")


def _wrapped(text: str, room_px: int) -> list[str]:
    """Lines of a text as wide as the frame; what the foot has no room for is not shown, and dots say so."""
    font, lines = _font(3.0), [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if font.getlength(longer) <= room_px:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines if len(lines) <= _MOST_LINES else [*lines[: _MOST_LINES - 1], lines[_MOST_LINES - 1] + " ..."]


def _scale_bar(draw: "ImageDraw", frame: _Frame, x: float, y: float) -> None:
    """Four alternating parts of a round length, some 100 mm in all."""
    part = max(s for s in _STEPS_M if s / frame.metres <= 28.0 * _MM or s == _STEPS_M[0])
    wide = part / frame.metres
    for k in range(4):
        box = (x + k * wide, y, x + (k + 1) * wide, y + 2.5 * _MM)
        draw.rectangle(box, outline=_INK, fill=_INK if k % 2 == 0 else "white")
        draw.text((box[0], y + 3.2 * _MM), f"{k * part:g}", fill=_INK, font=_font(2.6), anchor="mt")
    draw.text((x + 4 * wide, y + 3.2 * _MM), f"{4 * part:g} m", fill=_INK, font=_font(2.6), anchor="mt")


def _degrees(value: float, letters: str) -> str:
    return f"{abs(value):.5f}° {letters[value < 0]}"


def _font(height_mm: float, text: str = "") -> Any:
    from PIL import ImageFont

    return ImageFont.truetype(_font_file(text)[0], round(height_mm * _MM))


@lru_cache(maxsize=256)
def _font_file(text: str) -> tuple[Path, frozenset[str]]:
    """The font of a text, one of this machine where our own lacks letters; and the letters that it lacks, too."""
    import matplotlib
    from matplotlib.ft2font import FT2Font

    def lacks(path: Path) -> frozenset[str]:
        known = FT2Font(str(path)).get_charmap()
        return frozenset(letter for letter in text if not letter.isspace() and ord(letter) not in known)

    own = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    if not (missing := lacks(own)):
        return own, missing
    from matplotlib.font_manager import findSystemFonts

    for path in sorted(map(Path, findSystemFonts())):
        with suppress(RuntimeError, OSError):  # fonts of kinds that FreeType does not read
            if not lacks(path):
                return path, frozenset()
    return own, missing


def _save(page: Any, frame: _Frame, epsg: int, path: Path, title: str) -> None:
    """Write the page; its neat line says that only the frame is a map."""
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.io import MemoryFile
    from rasterio.shutil import copy
    from rasterio.transform import from_origin

    left, top, right, bottom = frame.box
    west, north = frame.west - left * frame.metres, frame.north + top * frame.metres
    corners = [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
    ring = ", ".join(f"{west + x * frame.metres} {north - y * frame.metres}" for x, y in corners)
    width, height = frame.page
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 3, "dtype": "uint8", "crs": f"EPSG:{epsg}"}
    try:
        with MemoryFile() as memory:
            with memory.open(**profile, transform=from_origin(west, north, frame.metres, frame.metres)) as raster:
                raster.write(np.asarray(page).transpose(2, 0, 1))
            with rasterio.open(memory.name) as raster:
                copy(
                    raster, str(path), driver="PDF", DPI=str(_DPI), COMPRESS="JPEG", JPEG_QUALITY="88",
                    GEO_ENCODING="ISO32000", NEATLINE=f"POLYGON (({ring}))", LAYER_NAME="Map", TITLE=title,
                )  # fmt: skip
    except RasterioError as error:
        raise OrthoSwarmError(f"{path.name} cannot be written ({error}); see whether the disk is full") from None
    path.with_name(path.name + ".aux.xml").unlink(missing_ok=True)


# -- MGRS (NGA.STND.0037, "Universal Grids and Grid Reference Systems") ------------------------------------------------

_BANDS: Final = "CDEFGHJKLMNPQRSTUVWX"
_COLUMNS: Final = ("ABCDEFGH", "JKLMNPQR", "STUVWXYZ")
_ROWS: Final = "ABCDEFGHJKLMNPQRSTUV"
_SQUARE_M: Final = 100_000


def utm_zone(epsg: int) -> int | None:
    """Number of the UTM zone of EPSG 32601 to 32660 and 32701 to 32760, None for another system."""
    zone = epsg % 100
    return zone if epsg // 100 in (326, 327) and 1 <= zone <= 60 else None


def grid_zone(zone: int, lat_deg: float) -> str:
    """Zone and latitude band, for example `48R`."""
    return f"{zone}{_BANDS[min(max(math.floor((lat_deg + 80.0) / 8.0), 0), 19)]}"


def square(zone: int, east_m: float, north_m: float) -> str:
    """The two letters of the square of 100 km.

    zone: of UTM. east_m, north_m: grid metres, on the south with the false northing of 10,000 km.
    """
    column = _COLUMNS[(zone - 1) % 3][(math.floor(east_m / _SQUARE_M) - 1) % 8]
    return column + _ROWS[(math.floor(north_m / _SQUARE_M) + (0 if zone % 2 else 5)) % 20]

"""The offline pack: one ZIP with the map in every form, and a page that shows it without a server and internet."""

import itertools
import json
import shutil
import sqlite3
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.sheets.geopdf import write_geopdf
from orthoswarm.export.sheets.stac_item import SURFACE, surface_path, time_span, write_stac_item
from orthoswarm.export.sheets.stated_accuracy import stated_accuracy
from orthoswarm.export.tactical.cursor_on_target import write_data_package
from orthoswarm.export.tactical.places import PLACE_FILES, Place
from orthoswarm.export.tiles.kmz import kmz_file
from orthoswarm.export.tiles.mbtiles import mbtiles_file, write_pmtiles
from orthoswarm.export.tiles.tile_pyramid import draw_tiles

_PAGE: Final = Path(__file__).with_name("pack_page.html")
_PURPOSES: Final = {
    "orthoimage.tif": "For QGIS: the orthoimage (GeoTIFF)",
    "orthoimage.stac.json": "For catalogues: what it is, when and how accurate (STAC)",
    "footprints.gpkg": "For QGIS: footprints of the pictures (GeoPackage)",
    "seamlines.gpkg": "For QGIS: which picture shows which ground (GeoPackage)",
    "confidence.tif": "For QGIS: how far each place can be trusted (GeoTIFF)",
    "temperature.tif": "For QGIS: temperature of the ground, degrees Celsius (GeoTIFF)",
    "change.tif": "For QGIS: where the ground changed (GeoTIFF)",
    "change.gpkg": "For QGIS: changed ground with area, kind and photos (GeoPackage)",
    SURFACE: "For QGIS: heights of the surface (GeoTIFF)",
    "orthoimage.mbtiles": "For phones and tablets (MBTiles)",
    "orthoimage.pmtiles": "For web maps (PMTiles)",
    "orthoimage.kmz": "For Google Earth (KMZ)",
    "sheet.pdf": "For print: a sheet with grid and scale (GeoPDF)",
    "places-tak.zip": "For ATAK and WinTAK: finds and vehicles (data package)",
    "places.geojson": "Finds and vehicles (GeoJSON)",
    "places.kml": "Finds and vehicles (KML)",
    "places.gpx": "For CalTopo and receivers: finds and vehicles (GPX)",
    "places.csv": "Finds and vehicles as a table (CSV)",
    "report.html": "Report of the map",
    "log.csv": "Who did what when (CSV)",
}
_STORED: Final = frozenset({".tif", ".webp", ".kmz", ".pdf", ".zip", ".mbtiles", ".pmtiles"})


def write_pack(
    cog: Path, path: Path, places: Sequence[Place] = (), progress: Callable[[int, int], None] | None = None
) -> None:
    """Write the pack of a map.

    Args:
        cog: the orthoimage; the surface model, footprints.gpkg, seamlines.gpkg, confidence.tif, change.tif and .gpkg,
            report.html and log.csv beside it go in if there.
        path: the ZIP. places: finds and vehicles. progress: called with steps done and steps in all.

    Raises:
        InputError: the map cannot be read.
        OrthoSwarmError: the disk is full.
    """
    tell = progress or (lambda done, of: None)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".pack") as name:
        folder = Path(name)
        tiles = folder / "orthoimage.mbtiles"
        title = cog.resolve().parent.name or "map"
        bounds: list[tuple[float, ...]] = []
        web: list[Callable[[], object]] = [
            lambda: bounds.append(_draw_tiles(cog, tiles, folder / "orthoimage.kmz")),
            lambda: write_pmtiles(tiles, folder / "orthoimage.pmtiles"),
        ]
        others: list[Callable[[], object]] = [
            lambda: write_geopdf(cog, folder / "sheet.pdf", places, title),
            lambda: write_data_package(places, folder / "places-tak.zip", title),
            *(partial(write, places, folder / name) for name, write in PLACE_FILES.items()),
            lambda: _copy(cog, folder),
            lambda: write_stac_item(folder / "orthoimage.tif", folder / "orthoimage.stac.json", copy_of=cog),
        ]
        done = itertools.count(1)
        count = len(web) + len(others) + 1

        def run(steps: Sequence[Callable[[], object]]) -> None:
            for step in steps:
                step()
                tell(next(done), count)

        with ThreadPoolExecutor(2) as pool:  # the tiles take longest
            for running in [pool.submit(run, web), pool.submit(run, others)]:
                running.result()
        with closing(sqlite3.connect(tiles)) as database, atomic_write(path) as part:
            stated = stated_accuracy(cog.parent, cog.stem)
            about = {"bounds": bounds[0], "accuracy": stated.sentence if stated else ""}
            _zip(database, folder, part, places=places, title=title, about=about)
        tell(count, count)


def _draw_tiles(cog: Path, mbtiles: Path, kmz: Path) -> tuple[float, ...]:
    """Both files of one drawing; returns its bounds, see `Pyramid`."""
    with mbtiles_file(mbtiles, tile_format="webp") as web, kmz_file(kmz) as globe:
        return draw_tiles(cog, [web, globe]).whole_pixel_bounds()


def _copy(cog: Path, folder: Path) -> None:
    """The files that there are beside the orthoimage already; report.json and frames.jsonl say time and accuracy."""
    shutil.copyfile(cog, folder / "orthoimage.tif")
    surface = surface_path(cog.parent)
    if surface is not None:
        shutil.copyfile(surface, folder / SURFACE)
    products = ("footprints.gpkg", "seamlines.gpkg", "confidence.tif", "report.html", "report.json", "frames.jsonl")
    for name in (*products, "temperature.tif", "log.csv", "change.tif", "change.gpkg"):
        if (cog.parent / name).is_file():
            shutil.copyfile(cog.parent / name, folder / name)


def _zip(
    database: sqlite3.Connection, folder: Path, path: Path, *, places: Sequence[Place], title: str,
    about: dict[str, Any],
) -> None:  # fmt: skip
    """Write the archive: the tiles, the page with what it shows, and the files that are there."""
    top, span = f"{title}-map", time_span(folder)
    drawn = dict(database.execute("SELECT name, value FROM metadata"))
    files = [name for name in _PURPOSES if (folder / name).is_file()]
    tiles = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for zoom, x, row, data in database.execute("SELECT zoom_level, tile_column, tile_row, tile_data FROM tiles"):
            tiles.append(f"{zoom}/{x}/{2**zoom - 1 - row}")  # rows from the north
            archive.writestr(f"{top}/tiles/{tiles[-1]}.webp", data, zipfile.ZIP_STORED)
        document = {
            "title": title, "about": f"Pictures of {span}." if span else "",
            "minzoom": int(drawn["minzoom"]), "maxzoom": int(drawn["maxzoom"]), "tiles": tiles,
            "finds": [
                {"name": p.name, "lat": p.lat_deg, "lon": p.lon_deg, "sigma": p.sigma_m, "note": p.note}
                for p in places
                if p.kind == "find"
            ],
            "files": [{"name": name, "purpose": _PURPOSES[name]} for name in files], **about,
        }  # fmt: skip
        script = json.dumps(document, ensure_ascii=True).replace("<", "\\u003c")  # which cannot end the page's script
        archive.writestr(f"{top}/index.html", _PAGE.read_text(encoding="utf-8").replace("/*PACK*/null", script))
        for name in files:
            packed = zipfile.ZIP_STORED if Path(name).suffix in _STORED else zipfile.ZIP_DEFLATED
            archive.write(folder / name, f"{top}/{name}", packed)

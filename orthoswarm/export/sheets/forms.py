"""The forms of a finished map that are made of its orthoimage and its places: their names, files and writers."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from orthoswarm.export.sheets.geopdf import write_geopdf
from orthoswarm.export.sheets.pack import write_pack
from orthoswarm.export.sheets.stac_item import write_stac_item
from orthoswarm.export.tactical.cursor_on_target import write_data_package
from orthoswarm.export.tactical.place_files import write_csv, write_gpx, write_kml
from orthoswarm.export.tactical.places import Place, write_geojson
from orthoswarm.export.tiles.mbtiles import write_mbtiles
from orthoswarm.export.tiles.pmtiles import write_pmtiles

Tell = Callable[[int, int], None]
FORMS: Final = ("stac", "pmtiles", "pdf", "places", "tak", "pack")
_PLACES: Final = (write_geojson, write_kml, write_gpx, write_csv)
_SUFFIXES: Final = ("geojson", "kml", "gpx", "csv")


def write_form(name: str, cog: Path, dest: Path, places: Sequence[Place], tell: Tell | None = None) -> Path:
    """Write one of FORMS.

    Args:
        name: which. cog: the orthoimage, with frames.jsonl and report.json beside it. dest: folder for the file; a
            STAC item goes beside the orthoimage. places: finds and vehicles. tell: called with steps done and in all.

    Returns:
        The file, or for `places` the folder of GeoJSON, KML, GPX and CSV.

    Raises:
        InputError: the map cannot be read.
        OrthoSwarmError: the disk is full.
    """
    title = cog.resolve().parent.name or "map"
    if name == "pack":
        path = dest / f"{title}-map.zip"
        write_pack(cog, path, places, tell)
    elif name == "stac":
        path = cog.with_suffix(".stac.json")
        write_stac_item(cog, path)
    elif name == "pmtiles":
        path = dest / f"{cog.stem}.pmtiles"
        dest.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=dest, prefix=".tiles") as folder:
            tiles = Path(folder) / "tiles.mbtiles"
            write_mbtiles(cog, tiles, name=cog.stem, tile_format="webp", progress=tell)
            write_pmtiles(tiles, path)
    elif name == "pdf":
        path = dest / f"{cog.stem}.pdf"
        write_geopdf(cog, path, places, title)
    elif name == "tak":
        path = dest / "places-tak.zip"
        write_data_package(places, path, title)
    else:
        path = dest / "places"
        for write, suffix in zip(_PLACES, _SUFFIXES, strict=True):
            write(places, path / f"places.{suffix}")
    return path

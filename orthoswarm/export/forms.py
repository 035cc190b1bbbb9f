"""What a finished map is exported to: each form with its words and its writer, for the command line and the daemon."""

import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    from orthoswarm.export.tactical.places import Place
    from orthoswarm.export.tiles.mbtiles import Format

_NO_PLACES: Final = "there are no finds and no vehicles; `orthoswarm serve` keeps them as places.geojson in its folder"


@dataclass(frozen=True, kw_only=True)
class MapExport:
    """A map, and how it is to be exported."""

    folder: Path  # of the map, as `orthoswarm mosaic` and the daemon write it
    dest: Path  # folder for the files; a STAC item goes beside the orthoimage
    layer: str = ""  # "orthoimage", "coarse" or "realtime"; empty for the last that is there
    places: "Sequence[Place] | None" = None  # finds and vehicles; None for those that the folder keeps
    # returns the picture file of a line of frames.jsonl, None if it is missing; without it pictures are looked for in
    # `images`, or where they were when the map was made
    find: Callable[[Mapping[str, Any]], Path | None] | None = None
    images: Path | None = None
    tile_format: "Format" = "png"  # of MBTiles
    quality: int = 85  # of JPEG and WebP, 1 to 100
    epsg: int | None = None  # of the COG
    jpeg: bool = False  # of the COG
    tell: Callable[[int, int], None] = lambda done, of: None  # called with steps done and in all
    notes: list[str] = field(default_factory=list)  # what the user should know is added here

    @cached_property
    def picture(self) -> Path:
        """The raster to export. Raises InputError: there is none."""
        from orthoswarm.export.catalog.tiled_raster import product_file

        names = [self.layer] if self.layer else ["orthoimage", "coarse", "realtime"]
        path = next((path for name in names if (path := product_file(self.folder, f"{name}.tif"))), None)
        if path is None:
            raise InputError(
                f"{self.folder} holds no {' or '.join(names)}.tif; make the map with `orthoswarm mosaic` first"
            )
        return path

    @cached_property
    def all_places(self) -> "Sequence[Place]":
        """Finds and vehicles, and the largest changes that `orthoswarm change` has found.

        Raises InputError: the folder's list was changed to something else.
        """
        from orthoswarm.export.tactical.places import changed_places, read_places

        own = read_places(self.folder) if self.places is None else self.places
        return [*own, *changed_places(self.folder)]

    def file(self, suffix: str) -> Path:
        """Where a file goes that is named as the picture."""
        return self.dest / f"{self.picture.stem}.{suffix}"


def _mbtiles(what: MapExport) -> Path:
    from orthoswarm.export.tiles.mbtiles import write_mbtiles

    path, name = what.file("mbtiles"), what.picture.stem
    write_mbtiles(what.picture, path, name=name, tile_format=what.tile_format, quality=what.quality, progress=what.tell)
    return path


def _kmz(what: MapExport) -> Path:
    from orthoswarm.export.tiles.kmz import write_kmz

    write_kmz(what.picture, what.file("kmz"), name=what.picture.stem, progress=what.tell)
    return what.file("kmz")


def _gpkg(what: MapExport) -> Path:
    source, path = what.folder / "footprints.gpkg", what.dest / "footprints.gpkg"
    if not source.exists():
        raise InputError(f"{what.folder} holds no footprints.gpkg; make the map with `orthoswarm mosaic` first")
    with atomic_write(path) as part:
        shutil.copyfile(source, part)
    return path


def _cameras(kind: str, what: MapExport) -> Path:
    """A folder of another program with the refined cameras."""
    from orthoswarm.export.camera_folders import write_colmap, write_odm, write_opensfm
    from orthoswarm.export.product_files import read_frames
    from orthoswarm.stores.addresses import path_of

    lines, root = what.folder / "frames.jsonl", what.images
    if not lines.exists():
        raise InputError(f"{what.folder} holds no frames.jsonl; make the map with `orthoswarm mosaic` first")
    try:
        report = json.loads((what.folder / "report.json").read_text(encoding="utf-8"))
        rows = list(read_frames(lines))
    except (OSError, ValueError) as error:
        raise InputError(
            f"report.json or frames.jsonl of {what.folder} cannot be read ({error}); make it again"
        ) from None
    if root is None and report.get("root"):
        root = path_of(report["root"])

    def find(row: Mapping[str, Any]) -> Path | None:
        path = root / row["image"] if root else None
        return path if path is not None and path.is_file() else None

    write = {"odm": write_odm, "colmap": write_colmap, "opensfm": write_opensfm}[kind]
    gone = write(rows, what.find or find, what.dest / kind, progress=what.tell)
    if gone:
        what.notes.append(f"{len(gone)} pictures are not where they were and were left out, the first is {gone[0]}")
    return what.dest / kind


def _cog(what: MapExport) -> Path:
    from orthoswarm.export.cog import convert_cog

    path, quality = what.file("tif"), what.quality if what.jpeg else None
    doubt = convert_cog(what.picture, path, epsg=what.epsg, jpeg_quality=quality)
    what.notes.extend([doubt] if doubt else [])
    return path


def _stac(what: MapExport) -> Path:
    from orthoswarm.export.sheets.stac_item import write_stac_item

    path = what.picture.with_suffix(".stac.json")
    write_stac_item(what.picture, path)
    return path


def _pmtiles(what: MapExport) -> Path:
    from orthoswarm.export.tiles.mbtiles import write_mbtiles, write_pmtiles

    what.dest.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=what.dest, prefix=".tiles") as folder:
        tiles = Path(folder) / "tiles.mbtiles"
        write_mbtiles(what.picture, tiles, name=what.picture.stem, tile_format="webp", progress=what.tell)
        write_pmtiles(tiles, what.file("pmtiles"))
    return what.file("pmtiles")


def _pdf(what: MapExport) -> Path:
    from orthoswarm.export.sheets.geopdf import write_geopdf

    boxes = write_geopdf(what.picture, what.file("pdf"), what.all_places, _title(what))
    what.notes.extend([f"no font here has {boxes}; install one that does, and export again"] if boxes else [])
    return what.file("pdf")


def _places(what: MapExport) -> Path:
    from orthoswarm.export.tactical.places import PLACE_FILES

    for name, write in PLACE_FILES.items():
        write(what.all_places, what.dest / "places" / name)
    what.notes.extend([] if what.all_places else [_NO_PLACES])
    return what.dest / "places"


def _tak(what: MapExport) -> Path:
    from orthoswarm.export.tactical.cursor_on_target import write_data_package

    path = what.dest / "places-tak.zip"
    write_data_package(what.all_places, path, _title(what))
    what.notes.extend([] if what.all_places else [_NO_PLACES])
    return path


def _pack(what: MapExport) -> Path:
    from orthoswarm.export.sheets.pack import write_pack

    path = what.dest / f"{_title(what)}-map.zip"
    write_pack(what.picture, path, what.all_places, what.tell)
    return path


def _title(what: MapExport) -> str:
    return what.picture.resolve().parent.name or "map"


@dataclass(frozen=True, slots=True, kw_only=True)
class Form:
    """A form of a finished map."""

    use: str  # what it is for, in the help of the command line
    # writes it and returns the file or folder; raises InputError if the map cannot be read, OrthoSwarmError if the disk
    # is full
    write: Callable[[MapExport], Path]
    daemon: bool = True  # whether the daemon writes it, too
    report: bool = True  # whether it says what report.json says
    replaces: bool = False  # whether in a map's folder it would replace a file of the map


FORMS: Final = {
    "mbtiles": Form(use="web map tiles for tablets and offline maps", write=_mbtiles, report=False),
    "kmz": Form(use="Google Earth, ATAK and other globes", write=_kmz, report=False),
    "gpkg": Form(use="footprints of the pictures as polygons", write=_gpkg, report=False, replaces=True),
    "odm": Form(use="pictures and refined positions for OpenDroneMap", write=partial(_cameras, "odm")),
    "colmap": Form(
        use="refined cameras as a COLMAP model, to densify from", write=partial(_cameras, "colmap"), daemon=False
    ),
    "opensfm": Form(
        use="refined cameras as an OpenSfM reconstruction, to densify from", write=partial(_cameras, "opensfm"),
        daemon=False,
    ),
    "cog": Form(
        use="the orthoimage in another coordinate system or as a small JPEG", write=_cog, report=False, replaces=True
    ),
    "stac": Form(use="a STAC item beside the orthoimage, for catalogues", write=_stac),
    "pmtiles": Form(use="web map tiles in one file for web servers", write=_pmtiles, report=False),
    "pdf": Form(use="a sheet of A3 with grid, scale and accuracy (GeoPDF)", write=_pdf),
    "places": Form(use="finds and vehicles as GeoJSON, KML, GPX and CSV", write=_places, replaces=True),
    "tak": Form(use="finds and vehicles as a data package for ATAK and WinTAK", write=_tak),
    "pack": Form(use="all of it in one ZIP, with a page that opens without a server", write=_pack),
}  # fmt: skip

"""Coverage as files: cells as GeoTIFF, gaps as GeoJSON, GeoPackage and KML, both as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.coverage.coverage_grid import CellState, CoverageGrid
from orthoswarm.coverage.gaps import CoverageGap, Gaps
from orthoswarm.export.atomic_file import atomic_write, write_file
from orthoswarm.export.product_files import write_json
from orthoswarm.export.xml_elements import element, kml_bytes, texts
from orthoswarm.model.geo import GroundGrid, LocalGrid

COLOURS = {
    CellState.OUTSIDE: (0, 0, 0, 0),
    CellState.PLANNED: (120, 150, 190, 90),
    CellState.SEEN: (0, 158, 115, 110),
    CellState.POOR: (240, 228, 66, 170),
    CellState.MISSED: (213, 94, 0, 190),
    CellState.EXCLUDED: (90, 90, 90, 150),
}
"""Red, green, blue, alpha of each state; those of ground that was flown over are Okabe and Ito's."""


def write_cells(path: Path, cover: CoverageGrid) -> None:
    """Write a GeoTIFF: band 1 state (with a colour table), band 2 flaws of the best view (255: none), band 3 views.

    Band 3 is the number of views without a flaw, at most 255.

    Raises OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    import rasterio

    grid = cover.cells.grid
    profile = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": 3, "dtype": "uint8",
        "crs": f"EPSG:{grid.epsg}", "transform": grid.affine(), "compress": "deflate", "tiled": True,
        "photometric": "MINISBLACK", "alpha": "NO",
    }  # fmt: skip
    with atomic_write(path) as part, rasterio.open(part, "w", **profile) as file:
        file.write(cover.states(), 1)
        file.write(cover.best, 2)
        file.write(np.minimum(cover.good, 255).astype(np.uint8), 3)
        for band, name in enumerate(("state", "flaws of the best view", "views without a flaw"), start=1):
            file.set_band_description(band, name)
        file.update_tags(1, **{f"value_{s.value}": s.name.lower() for s in CellState})


def gap_row(gap: CoverageGap, grid: LocalGrid) -> dict[str, Any]:
    """A gap's figures for JSON."""
    point = gap.polygon.representative_point()
    lat, lon = grid.to_geographic([point.x, point.y])
    return {
        "area_m2": round(gap.area_m2, 1),
        "cause": str(gap.cause),
        "detail": gap.detail,
        "confidence": round(gap.confidence, 2),
        "vehicle": gap.vehicle,
        "lat_deg": round(float(lat), 7),
        "lon_deg": round(float(lon), 7),
    }


def gap_feature(gap: CoverageGap, grid: LocalGrid) -> dict[str, Any]:
    """A gap as a GeoJSON feature."""
    geometry = {"type": "Polygon", "coordinates": _rings(gap, grid)}
    return {"type": "Feature", "properties": gap_row(gap, grid), "geometry": geometry}


def write_gaps(folder: Path, gaps: Gaps, grid: LocalGrid) -> None:
    """Write gaps.geojson, gaps.gpkg and gaps.kml.

    Raises OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    features = [gap_feature(gap, grid) for gap in gaps.gaps]
    rows = [(f["properties"], f["geometry"]["coordinates"]) for f in features]
    write_json(folder / "gaps.geojson", {"type": "FeatureCollection", "features": features})
    write_file(folder / "gaps.kml", _kml(rows))
    _write_gpkg(folder / "gaps.gpkg", gaps.gaps, [row for row, _ in rows], grid.epsg)


def _rings(gap: CoverageGap, grid: LocalGrid) -> list[list[list[float]]]:
    import shapely

    rings = shapely.get_rings(shapely.geometry.polygon.orient(gap.polygon))
    places = [grid.to_geographic(shapely.get_coordinates(ring)) for ring in rings]
    return [[[round(float(lon), 8), round(float(lat), 8)] for lat, lon in ring] for ring in places]


def _kml(rows: Sequence[tuple[dict[str, Any], list[list[list[float]]]]]) -> bytes:
    opacity = {"LineStyle": "ff", "PolyStyle": "80"}
    styles = [
        element("Style", *(element(tag, *texts(color=alpha + colour)) for tag, alpha in opacity.items()), id=name)
        for name, colour in (("missed", "2d2dd7"), ("poor", "28b4f5"))
    ]
    marks = []
    for row, (outer, *holes) in rows:
        name = f"{row['area_m2']:.0f} m2, {row['cause']}" + (f": {row['detail']}" if row["detail"] else "")
        borders = [("outerBoundaryIs", outer), *(("innerBoundaryIs", hole) for hole in holes)]
        rings = [
            element(tag, element("LinearRing", *texts(coordinates=" ".join(f"{x},{y}" for x, y in ring))))
            for tag, ring in borders
        ]
        style = "#poor" if row["detail"] else "#missed"
        marks.append(element("Placemark", *texts(name=name, styleUrl=style), element("Polygon", *rings)))
    return kml_bytes(*texts(name="gaps"), *styles, *marks)


def _write_gpkg(path: Path, gaps: Sequence[CoverageGap], rows: Sequence[dict[str, Any]], epsg: int) -> None:
    import pyogrio
    import shapely

    shapes = np.array([shapely.to_wkb(g.polygon) for g in gaps], object)
    fields = {"area_m2": np.float64, "cause": object, "detail": object, "confidence": np.float64, "vehicle": object}
    columns: list[NDArray[Any]] = [np.array([r[name] for r in rows], kind) for name, kind in fields.items()]
    with atomic_write(path) as part:
        pyogrio.raw.write(
            str(part), shapes, columns, list(fields), layer="gaps", driver="GPKG", geometry_type="Polygon",
            crs=f"EPSG:{epsg}",
        )  # fmt: skip


def draw_cells(path: Path, cover: CoverageGrid, gaps: Gaps, ortho: Path | None = None) -> None:
    """Draw states and outlines of gaps, over an orthoimage if there is one, as a PNG.

    Raises OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    grid = cover.cells.grid
    west, south, east, north = grid.bounds
    figure = Figure(figsize=(10.0, max(4.0, 10.0 * (north - south) / (east - west) + 1.2)), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    extent = (0.0, east - west, 0.0, north - south)
    if ortho is not None:
        axes.imshow(_background(ortho, grid), extent=extent)
    states = cover.states()
    table = np.array([COLOURS[s] for s in CellState], np.uint8)
    axes.imshow(table[states], extent=extent, interpolation="nearest")
    for number, gap in enumerate(gaps.gaps):
        x, y = np.array(gap.polygon.exterior.xy)
        axes.plot(x - west, y - south, color="black", linewidth=0.7)
        if number < 12:
            point = gap.polygon.representative_point()
            text = f"{gap.area_m2:.0f} m2\n{gap.detail or gap.cause}"
            box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.75, "linewidth": 0.4}
            axes.annotate(text, (point.x - west, point.y - south), fontsize=6, ha="center", va="center", bbox=box)
    shares = cover.shares()
    parts = {CellState.SEEN: shares.seen, CellState.POOR: shares.poor, CellState.MISSED: shares.missed}
    marks = [
        Patch(color=np.array(COLOURS[s]) / 255.0, label=f"{s.name.lower()} {100 * share:.2f} %")
        for s, share in parts.items()
    ]
    axes.legend(handles=marks, loc="upper right", fontsize=8)
    axes.set_xlabel("metres east")
    axes.set_ylabel("metres north")
    figure.tight_layout()
    with atomic_write(path) as part:
        figure.savefig(part, format="png")


def _background(ortho: Path, grid: GroundGrid) -> NDArray[np.uint8]:
    """The orthoimage in the grid's window, about 1600 pixels wide, uint8 (rows, columns, 4)."""
    import rasterio.transform
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    scale = 1600.0 / max(grid.width, grid.height)
    width, height = max(1, round(grid.width * scale)), max(1, round(grid.height * scale))
    affine = rasterio.transform.from_bounds(*grid.bounds, width, height)
    with (
        rasterio.open(ortho) as file,
        WarpedVRT(
            file, crs=f"EPSG:{grid.epsg}", transform=affine, width=width, height=height, resampling=Resampling.bilinear
        ) as view,
    ):
        return np.ascontiguousarray(np.moveaxis(view.read([1, 2, 3, 4]), 0, -1))

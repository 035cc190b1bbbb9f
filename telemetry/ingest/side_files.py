"""Ground control points and georeferenced rasters found next to pictures; they are reported, not mapped."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from telemetry.samples.findings import Finding


@dataclass(frozen=True, slots=True)
class ControlPoints:
    """Summary of an ODM control point file."""

    rows: int  # number of observations
    points: int  # number of points
    heights: tuple[float, ...]  # their z values
    widest: float  # largest column of a pixel
    images: frozenset[str]  # lower-case names of pictures


def read_control_points(path: Path) -> ControlPoints | None:
    """Read an ODM `gcp_list.txt` (projection, then x y z column row image); None if it is another file."""
    try:
        if path.stat().st_size > 8 << 20:
            return None
        lines = path.read_text("utf-8", "replace").splitlines()
    except OSError:
        return None
    points: dict[tuple[float, float], float] = {}
    images, widest, rows = set(), 0.0, 0
    for line in lines[1:]:
        words = line.split()
        try:
            x, y, z, column, _ = (float(word) for word in words[:5])
        except ValueError:
            continue
        if len(words) < 6 or Path(words[5]).suffix.lower() not in (".jpg", ".jpeg", ".tif", ".tiff", ".png", ".dng"):
            continue
        points[x, y] = z
        images.add(words[5].lower())
        widest, rows = max(widest, column), rows + 1
    return ControlPoints(rows, len(points), tuple(points.values()), widest, frozenset(images)) if rows else None


def control_point_findings(path: Path, points: ControlPoints, widths: Collection[int]) -> list[Finding]:
    """Findings on control points, given the widths of the pictures near them."""
    text = (
        f"{path.name} holds {points.points} ground control points in {points.rows} pictures; mosaic uses them where "
        "the file is given with --control"
    )
    found = [Finding("control-points", text, note=True)]
    width = max(widths, default=0)
    if width and points.widest > 1.05 * width:
        found.append(
            Finding(
                "control-points-scale",
                f"the pixels of {path.name} go up to column {points.widest:.0f}, but the pictures are {width} wide: "
                "they belong to larger originals and have to be scaled",
            )
        )
    if len(points.heights) > 2 and len(set(points.heights)) == 1:
        text = f"all control points of {path.name} have the same height, {points.heights[0]:g} m: it was not measured"
        found.append(Finding("control-points-height", text))
    return found


def raster_finding(path: Path) -> Finding | None:
    """Finding that describes a georeferenced raster; None if it cannot be read."""
    import rasterio
    from rasterio.errors import RasterioError

    try:
        with rasterio.open(path) as raster:
            gsd = abs(raster.transform.a)
            crs = raster.crs.to_string() if raster.crs else "no CRS"
            kind = raster.dtypes[0]
            unit = " m" if raster.crs and raster.crs.is_projected else ""
            what = "colours" if raster.count >= 3 and kind == "uint8" else "values, such as heights"
            use = "--basemap" if what == "colours" else "--dem"
            text = (
                f"{path.name} is a georeferenced raster and no picture of a camera: {raster.width} x {raster.height}, "
                f"{gsd:g}{unit} a pixel, {crs}, {raster.count} x {kind} {what}; give it with {use}"
            )
    except (RasterioError, OSError, ValueError):
        return None
    return Finding("raster", text, note=True)

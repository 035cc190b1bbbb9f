"""Orthoimages from cameras and terrain of another source, rendered by this program."""

from collections.abc import Sequence
from pathlib import Path

from orthoswarm.model.placement import PlacedFrame, Terrain


def paste(placed: Sequence[PlacedFrame], terrain: Terrain, epsg: int, out: Path) -> Path:
    """Render frames over a terrain into OUT/orthoimage.tif (COG, RGBA) and return its path.

    Args:
        placed: frames with cameras in the grid `epsg`; heights share the datum of the terrain.
        terrain: ground heights.
        epsg: the UTM zone.
        out: a folder, created if missing.
    """
    from orthoswarm.canvas.canvas import Canvas
    from orthoswarm.export.cog import write_cog
    from orthoswarm.model.geo import GroundGrid
    from orthoswarm.mosaic.extent import drawn_window, placed_bounds
    from orthoswarm.mosaic.footprint import default_gsd
    from orthoswarm.mosaic.renderer import render

    out.mkdir(parents=True, exist_ok=True)
    low, high = float(terrain.z.min()), float(terrain.z.max())
    gsd = default_gsd([p.camera for p in placed], low)
    grid = GroundGrid.around(epsg, placed_bounds(placed, low, high), gsd)
    with Canvas.create(out / "canvas", grid, plane="frame") as canvas:
        render(placed, terrain, canvas)
        write_cog(canvas, out / "orthoimage.tif", window=drawn_window(canvas))
    return out / "orthoimage.tif"

"""The surface model as a shaded relief for the report."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.report.report_pictures import PAPER

_MOST_PX = 1000
_LIGHT = np.array([-1.0, 1.0, 1.4]) / np.sqrt(1.0 + 1.0 + 1.4**2)
"""Towards the light, east, north, up: from the north-west at 45 degrees, as maps are shaded."""


def relief(height_m: NDArray[np.floating[Any]], cell_m: float) -> NDArray[np.uint8]:
    """Shaded relief, uint8 (rows, columns, 3), of heights (rows, columns; rows go south); NaN in the page's colour."""
    z = np.asarray(height_m, np.float64)
    south, east = np.gradient(z, cell_m)
    light = (-_LIGHT[0] * east + _LIGHT[1] * south + _LIGHT[2]) / np.sqrt(1.0 + east**2 + south**2)
    known = np.isfinite(light)
    grey = np.clip(40.0 + 215.0 * np.where(known, light, 0.0), 0, 255).astype(np.uint8)
    return np.where(known[..., None], grey[..., None], np.array(PAPER, np.uint8)).astype(np.uint8)


def surface_picture(surface: Mapping[str, Any]) -> tuple[NDArray[np.uint8], str]:
    """The picture of a surface model, and what it shows.

    Args:
        surface: `surface` of report.json.
    """
    import rasterio
    from rasterio.enums import Resampling

    with rasterio.open(Path(surface["file"])) as file:
        step = max(1, -(-max(file.height, file.width) // _MOST_PX))
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

"""A change map as a picture to be laid over a map, for the page and the report."""

import io
import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.change.change_files import FIGURES, RASTER
from orthoswarm.model.arrays import Bytes
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid

_LOW, _HIGH = (255, 176, 0), (214, 0, 84)  # colours of what is just likely enough, and of what is certain
_HIDDEN: Final = (90, 100, 115, 110)  # where nothing can be said
_ALPHA: Final = 175
_OVERLAY_PX: Final = 2048


def painted(chance: Bytes, visible: Bytes, inside: Bytes, threshold: float) -> Bytes:
    """Colours and opacity, uint8 (rows, columns, 4).

    Args:
        chance: 0 to 255. visible, inside: 0 where it cannot be said, and outside what was compared.
        threshold: probability from which ground is shown as changed.
    """
    share = np.clip((chance / 255.0 - threshold) / max(1.0 - threshold, 1e-3), 0.0, 1.0)[..., None]
    out = np.zeros((*chance.shape, 4), np.uint8)
    colors = np.array(_LOW) * (1.0 - share) + np.array(_HIGH) * share
    changed = (visible > 0) & (chance >= 255.0 * threshold)
    out[changed, :3], out[changed, 3] = colors[changed], _ALPHA
    out[(visible == 0) & (inside > 0)] = _HIDDEN
    return out


def change_overlay(folder: Path, threshold: float = 0.5) -> tuple[bytes, list[list[float]]]:
    """The change map of a folder as a PNG.

    Returns:
        The PNG, at most _OVERLAY_PX on its longer side; and the longitude and latitude of its corners in degrees: top
        left, top right, bottom right, bottom left.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    from PIL import Image

    picture, corners = overlay_pixels(folder, threshold)
    data = io.BytesIO()
    Image.fromarray(picture, "RGBA").save(data, "PNG")
    return data.getvalue(), corners


def overlay_pixels(folder: Path, threshold: float, bounds: tuple[float, ...] | None = None,
                   size: tuple[int, int] | None = None) -> tuple[Bytes, list[list[float]]]:  # fmt: skip
    """The pixels of `change_overlay`, of a window (west, south, east, north) in (rows, columns) if these are given."""
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.windows import from_bounds

    try:
        with rasterio.open(folder / RASTER) as file:
            step = max(1.0, max(file.shape) / _OVERLAY_PX)
            shape = size or tuple(max(1, round(side / step)) for side in file.shape)
            window = None if bounds is None else from_bounds(*bounds, file.transform)
            how: dict[str, Any] = {"out_shape": shape, "window": window, "resampling": Resampling.nearest}
            chance = file.read(1, boundless=window is not None, fill_value=0, **how)
            # Outside the flight there is nothing to say either; the band's value tells it from ground that is hidden.
            visible = file.read_masks(1, boundless=window is not None, **how)
            box, epsg = file.bounds, file.crs.to_epsg()
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{RASTER} of {folder} cannot be read ({error}); run `orthoswarm change` again") from None
    ring = [[box.left, box.top], [box.right, box.top], [box.right, box.bottom], [box.left, box.bottom]]
    corners = [[float(lon), float(lat)] for lat, lon in LocalGrid(epsg).to_geographic(ring)]
    return painted(chance, visible, ((visible == 0) & (chance > 0)).astype(np.uint8), threshold), corners


def figures_in(folder: Path) -> dict[str, Any] | None:
    """The figures of a folder's change map; None if it has none, or another version's."""
    try:
        figures = json.loads((folder / FIGURES).read_text(encoding="utf-8"))
        return figures if isinstance(figures, dict) and "objects" in figures else None
    except (OSError, ValueError):
        return None

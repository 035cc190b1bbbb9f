"""The section of report.html on what changed since the pre-disaster map."""

from html import escape
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.change.overlay import figures_in, overlay_pixels
from orthoswarm.export.atomic_file import write_file
from orthoswarm.export.catalog.tiled_raster import product_file
from orthoswarm.report.report_pictures import data_uri, pale, product_bounds, product_picture, scale_bar, view_grid

_BEGIN, _END = "<!-- change -->", "<!-- /change -->"
_WIDTH_PX: Final = 900
_SHOWN: Final = 0.5  # probability from which ground is painted


def put_section(folder: Path, change: Path) -> bool:
    """Put the change map of a folder into report.html of a map, in the place of an earlier one; False without a report.

    Raises OrthoSwarmError: the disk is full.
    """
    report, figures = folder / "report.html", figures_in(change)
    orthoimage = product_file(folder, "orthoimage.tif")
    if not report.is_file() or figures is None or orthoimage is None:
        return False
    before, begin, rest = report.read_text(encoding="utf-8").partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not begin or not end:
        return False
    grid = view_grid(figures["epsg"], product_bounds(orthoimage), _WIDTH_PX)
    picture = pale(product_picture(orthoimage, grid), 0.5)
    paint, _ = overlay_pixels(change, _SHOWN, tuple(grid.bounds), (grid.height, grid.width))
    share = paint[..., 3:] / 255.0
    picture.rgb[:] = np.round(picture.rgb * (1.0 - share) + paint[..., :3] * share)
    scale_bar(picture)
    rows = "".join(
        f"<tr><td>{row['area_m2']:,.0f} m²</td><td>{escape(row['kind'])}</td><td>{row['probability']:.0%}</td>"
        f"<td>{row['lat_deg']:.6f}, {row['lon_deg']:.6f}</td>"
        f"<td>{escape(', '.join(photo['image'] for photo in row['photos'][:1]))}</td></tr>"
        for row in figures["largest"]
    )
    text = (
        f"{figures['changed_share']:.1%} of the ground differs from {escape(figures['basemap'])} with a probability of "
        f"at least one half; {figures['not_visible_share']:.1%} could not be compared (grey). Yellow is likely, red "
        "certain. Cells and polygons with photos: change.tif and change.gpkg."
    )
    table = "<table><tr><th>area</th><th>kind</th><th>probability</th><th>place</th><th>photo</th></tr>" + rows
    section = (
        f'<figure id="change"><h2>What changed</h2><img src="{data_uri(picture.rgb)}" alt="ground that changed">'
        f"<figcaption>{text}</figcaption>{table + '</table>' if rows else ''}</figure>"
    )
    write_file(report, before + begin + section + end + after)
    return True

"""A picture with the maps of all programs side by side, each with its accuracy."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

Cell = tuple[str, Path | None]
"""Title above a map, and its thumbnail; None where there is no map."""


def contact_sheet(rows: Sequence[tuple[str, Sequence[Cell]]], out: Path) -> None:
    """Draw rows of maps, one row for each set.

    Args:
        rows: the name of each set and its maps.
        out: a JPEG.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from PIL import Image

    columns = max(len(cells) for _, cells in rows)
    size = (2.6 * columns, 3.4 * len(rows))
    figure, grid = pyplot.subplots(len(rows), columns, figsize=size, squeeze=False, layout="constrained")
    for axes_of_row, (name, cells) in zip(grid, rows, strict=True):
        axes_of_row[0].set_ylabel(name, fontsize=8)
        for axes in axes_of_row:
            axes.set(xticks=[], yticks=[], frame_on=False)
        for axes, (title, picture) in zip(axes_of_row, cells, strict=False):
            axes.set_title(title, fontsize=8)
            if picture is not None and picture.exists():
                with Image.open(picture) as image:
                    axes.imshow(image.convert("RGB"))
            else:
                axes.text(0.5, 0.5, "no map", ha="center", va="center", fontsize=9)
    part = out.with_suffix(".part")
    figure.savefig(part, dpi=110, format="jpg", pil_kwargs={"quality": 88})
    pyplot.close(figure)
    os.replace(part, out)


def verdict(title: str, row: dict[str, Any]) -> str:
    """Title above a map: the program and the share of the ground within 1 m of its true position."""
    if "error" in row:
        return f"{title}\nfailed"
    if row["right_share"] is None:
        return f"{title}\nno place; shape {100 * (row['shape_share'] or 0.0):.0f} % within 1 m"
    return f"{title}\n{100 * row['right_share']:.0f} % within 1 m"

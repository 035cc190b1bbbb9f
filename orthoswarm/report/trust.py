"""How far a map can be trusted, in a responder's words and as a picture."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.mosaic.confidence import GOOD_TO_M, ORIENTATION_ONLY
from orthoswarm.report.report_pictures import Picture, pale, scale_bar

_COLOURS: Final = ((0, 140, 90), (120, 190, 60), (230, 159, 0), (190, 30, 60))  # of the classes, best first
_TINT: Final = 0.5
_MOST: Final = 0.5  # so much of a map must be more than for orientation, and so much of that as good as is said
_OVERLAY_PX: Final = 2048
_SOME: Final = 0.02  # less of the map is not worth a word


def headline(report: Mapping[str, Any]) -> str:
    """One sentence: how good the map is, what was checked, and where it is only for orientation; "" if not known."""
    trust = report.get("trust")
    if not trust:
        return ""
    known = max(trust["good_to_m"].values())
    least = _MOST * known if known >= _MOST else math.inf
    usual = next((name for name, share in trust["good_to_m"].items() if share >= least), None)
    on_map, whole = bool(report["basemap"]) and trust["whole_good_to_m"] == 0.0, trust["whole_good_to_m"]
    rough = 1.0 - known
    good = "for orientation only"
    if usual:
        size = f"about {_length(float(usual))}"
        good = f"places lie within {size} of the pre-disaster map" if on_map else f"distances are good to {size}"
    where = [_edges(trust["doubtful_sides"])] if trust["doubtful_sides"] else []
    where += ["what stands high"] if trust["leaning_share"] > _SOME else []
    doubt = f"{_listed(where)} only for orientation" if usual and rough > _SOME and where else ""
    said = "; ".join(part for part in (good, _absolute(report, whole), doubt) if part)
    return said[0].upper() + said[1:] + "."


def _edges(sides: list[str]) -> str:
    return "the edges" if len(sides) == 4 else f"the {_listed(sides)} edge{'s' if len(sides) > 1 else ''}"


def _absolute(report: Mapping[str, Any], whole_m: float) -> str:
    """What is known of the place of the map as a whole."""
    if report.get("checkpoints"):
        return f"checked at surveyed points: {report['checkpoints']['rmse_h_m']:.2f} m (RMSE)"
    if report.get("control"):
        return "placed on surveyed points, and not checked at others"
    if whole_m > 0.0:
        return f"the whole map lies within about {_length(whole_m)} of where the receivers say"
    return "absolute position not checked"


def sentences(report: Mapping[str, Any]) -> str:
    """Three sentences below the picture."""
    trust = report["trust"]
    shares = trust["good_to_m"]
    parts = [f"{share:.0%} to {_length(float(name))}" for name, share in shares.items()]
    rest = 1.0 - max(shares.values())
    return (
        f"Of the map are good: {', '.join(parts)} or better; {rest:.0%} is only for orientation (red). "
        f"Roofs, trees and the ground behind them may lie more than half a metre off ({trust['leaning_share']:.0%} of "
        f"the map), as may what one picture shows alone ({trust['single_picture_share']:.0%}) or from far aside. "
        "confidence.tif has the number of each place, and why."
    )


def trust_picture(confidence: Path, ortho: Picture) -> Picture:
    """The classes of a confidence.tif over a pale orthoimage."""
    import rasterio
    from rasterio.vrt import WarpedVRT

    grid = ortho.grid
    out = pale(ortho, 0.8)
    with (
        rasterio.open(confidence) as file,
        WarpedVRT(file, crs=file.crs, transform=grid.affine(), width=grid.width, height=grid.height) as view,
    ):
        good = view.read(1)
    for value, colour in zip((*GOOD_TO_M, ORIENTATION_ONLY), _COLOURS, strict=True):
        of_class = (np.abs(good - value) < 1e-3) & out.seen
        out.rgb[of_class] = ((1 - _TINT) * out.rgb[of_class] + _TINT * np.array(colour)).astype(np.uint8)
    scale_bar(out)
    return out


def trust_overlay(confidence: Path) -> tuple[bytes, list[list[float]]]:
    """The classes of a confidence.tif as a PNG to be laid over a map.

    Returns:
        The PNG, at most _OVERLAY_PX on its longer side, transparent where nothing is drawn; and the longitude and
        latitude of its corners in degrees: top left, top right, bottom right, bottom left.

    Raises:
        InputError: the file cannot be read.
    """
    import io

    import rasterio
    from PIL import Image

    try:
        with rasterio.open(confidence) as file:
            step = max(1.0, max(file.shape) / _OVERLAY_PX)
            size = tuple(max(1, round(side / step)) for side in file.shape)
            good = file.read(1, out_shape=size, resampling=rasterio.enums.Resampling.nearest)
            box, epsg = file.bounds, file.crs.to_epsg()
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{confidence.name} cannot be read ({error}); export again") from None
    out = np.zeros((*good.shape, 4), np.uint8)
    for value, colour in zip((*GOOD_TO_M, ORIENTATION_ONLY), _COLOURS, strict=True):
        out[np.abs(good - value) < 1e-3] = (*colour, 255 * _TINT)
    data = io.BytesIO()
    Image.fromarray(out, "RGBA").save(data, "PNG")
    ring = [[box.left, box.top], [box.right, box.top], [box.right, box.bottom], [box.left, box.bottom]]
    return data.getvalue(), [[float(lon), float(lat)] for lat, lon in LocalGrid(epsg).to_geographic(ring)]


def _length(metres: float) -> str:
    if metres < 1.0:
        return f"{100 * metres:.0f} cm"
    return f"{math.ceil(metres)} m"


def _listed(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)

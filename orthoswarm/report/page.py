"""report.html: the state of the map in words, its pictures, and the numbers behind them."""

import base64
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm import __version__
from orthoswarm.change.change_files import figures_in, overlay_pixels
from orthoswarm.export.atomic_file import write_file
from orthoswarm.export.catalog.tiled_raster import product_file
from orthoswarm.export.product_files import iso_time
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.frame import Rejection
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.mosaic.footprint import footprint
from orthoswarm.raster.basemap import Basemap
from orthoswarm.report.report_pictures import (
    MapView,
    Moved,
    Picture,
    data_uri,
    draw_arrows,
    draw_lines,
    fill_polygons,
    map_edges,
    moved,
    pale,
    product_bounds,
    product_picture,
    scale_bar,
    surface_picture,
    view_grid,
)
from orthoswarm.report.trust import sentences, trust_picture

ORTHOIMAGE = "orthoimage.tif"
_STAGES = (
    ("realtime.tif", "Real time", "as recorded, no matching"),
    ("coarse.tif", "Coarse", "pictures adjusted to each other"),
    (ORTHOIMAGE, "Fine", "registered onto the pre-disaster map"),
)
_FINE_M, _PART_PX = 1.2, 640
_EDGE = (255, 214, 0)
_ARROW = (208, 30, 60)
PALETTE = (
    (0, 114, 178), (213, 94, 0), (86, 180, 233), (204, 121, 167), (0, 158, 115),
    (136, 0, 238), (85, 34, 0), (51, 51, 68), (187, 204, 119), (221, 0, 68),
)  # fmt: skip
"""Colours that stay apart on photographs and in print: five of Okabe and Ito's, and others that differ from all before
by at least 16 (CIE 1976), also as seen without red, green or blue cones (Machado and others 2009)."""
_LEGS = {"matched": (0, 158, 115), "carried": (230, 159, 0), "failed": (163, 32, 13)}
_LEG_WIDTHS = {"matched": 2, "carried": 4, "failed": 7}  # pixels: which is which can be seen without the colours

_LEAST_PICTURE_PX: Final = 200
"""Side that pictures of the report have at least where a map's pixel is large (one of 640 m would leave nothing to
see)."""
_BEGIN, _END = "<!-- change -->", "<!-- /change -->"
_WIDTH_PX: Final = 900
_SHOWN: Final = 0.5  # probability from which ground is painted


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture of the page: its heading, the picture inside the page, and what it shows."""

    title: str
    uri: str
    text: str


def write_page(
    out: Path,
    report: Mapping[str, Any],
    placed: Sequence[PlacedFrame],
    *,
    rejected: Sequence[Rejection],
    basemap: Basemap | None,
    cells: bytes = b"",
) -> dict[str, float | int] | None:
    """Write report.html beside the products.

    Args:
        out: output folder with the products. report: content of report.json. placed: the frames as last placed.
        rejected: the pictures that were left out. basemap: the map, if there is one.
        cells: picture of the cells of the coverage (PNG), empty without one.

    Returns:
        How far blocks of the orthoimage lie from the map: `median` and `p95` in metres, `blocks` that were found. The
        finished picture is compared, not the tie points that placed it; but with the map, not with the ground. None
        without a map, or where control points placed the orthoimage elsewhere.

    Raises:
        OrthoSwarmError: if the disk is full.
    """
    import jinja2

    best = next((path for name, _, _ in reversed(_STAGES) if (path := product_file(out, name))), None)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("orthoswarm.report", "."), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    values: dict[str, Any] = {
        "report": report,
        "version": __version__,
        "name": out.resolve().name,
        "rejected": rejected,
        "cells": f"data:image/png;base64,{base64.b64encode(cells).decode('ascii')}" if cells else "",
    }
    shifts = None
    if best is not None:
        bounds = product_bounds(best)
        coarsest = max(bounds.width, bounds.height) / _LEAST_PICTURE_PX
        least = max(float(report["gsd_m"]), min(basemap.native_gsd_m, coarsest) if basemap else 0.0)
        ortho = product_picture(best, view_grid(report["epsg"], bounds, 2000, least))
        there = None if basemap is None else MapView.read(basemap, ortho.grid)
        if basemap is not None and there is not None and not report.get("control"):  # which moved it off the map
            shifts = shifts_against_map(best, ortho, there, basemap, least)
            values["edges"] = _edge_crops(best, ortho, there, basemap)
        values |= _pictures(out, ortho, report, placed=placed, there=there, shifts=shifts)
    if report.get("surface"):
        shaded, text = surface_picture(report["surface"])
        values["surface"] = Figure("Surface model", data_uri(shaded), text)
    values["headline"] = report.get("headline", "")
    values["verdict"] = _verdict(report, placed, shifts)
    values["facts"] = _facts(report, placed, shifts)
    values["fov"] = fields_of_view(report["vehicles"])
    values["times"] = time_bars(report["stages"])
    values["legs"], values["on_map"] = _leg_summary(report), _on_map(report)
    write_file(out / "report.html", environment.get_template("page.html.j2").render(values))
    if shifts is None or not len(shifts.at):
        return None
    median, p95 = (float(v) for v in np.percentile(shifts.size_m, (50.0, 95.0)))
    return {"median": median, "p95": p95, "blocks": len(shifts.at)}


def shifts_against_map(
    best: Path,
    ortho: Picture,
    there: MapView,
    basemap: Basemap,
    least_gsd_m: float,
    *,
    fine_m: float = _FINE_M,
    part_px: int = _PART_PX,
) -> Moved:
    """Where blocks of the map are found in the orthoimage; of a large area in nine parts of it.

    Pixels of some metres would compare roofs, which lean, and not roads.

    Args:
        best: file of the orthoimage. ortho: the same, reduced. there: the map on its grid. basemap: the map.
        least_gsd_m: of orthoimage and map, metres. fine_m: largest pixel with which blocks are compared, metres.
        part_px: side of a part, pixels.
    """
    if ortho.grid.gsd_m <= fine_m:
        return _moved(ortho, there)
    west, south, east, north = ortho.grid.bounds
    gsd = max(least_gsd_m, 0.5 * fine_m)
    half = 0.5 * part_px * gsd
    parts = []
    for i, j in itertools.product((1, 3, 5), repeat=2):
        x, y = west + i / 6 * (east - west), south + j / 6 * (north - south)
        grid = GroundGrid(epsg=ortho.grid.epsg, west=x - half, north=y + half, gsd_m=gsd, width=part_px, height=part_px)
        part, its_map = product_picture(best, grid), MapView.read(basemap, grid)
        if its_map is not None and part.seen.any():
            parts.append(_moved(part, its_map))
    return Moved.joined(parts)


def _moved(ortho: Picture, there: MapView) -> Moved:
    import cv2

    return moved(cv2.cvtColor(ortho.rgb, cv2.COLOR_RGB2GRAY), ortho.seen, there.gray, there.valid, there.grid)


def _pictures(
    out: Path,
    ortho: Picture,
    report: Mapping[str, Any],
    *,
    placed: Sequence[PlacedFrame],
    there: MapView | None,
    shifts: Moved | None,
) -> dict[str, Any]:
    """All figures, largest first."""
    epsg, step = ortho.grid.epsg, ortho.grid.gsd_m
    main = ortho.on(view_grid(epsg, ortho.grid.bounds, 1400, step))
    small = view_grid(epsg, ortho.grid.bounds, 760, step)
    reduced = ortho.on(small)
    scale_bar(main)
    stages = []
    on_map = any(p.stage == "fine" for p in placed)
    for name, title, text in _STAGES:
        path = product_file(out, name)
        if path is not None and (name != ORTHOIMAGE or on_map):
            stages.append(Figure(title, data_uri(product_picture(path, small).rgb), text))
    return {
        "main": data_uri(main.rgb, 86),
        "stages": stages if len(stages) > 1 else [],
        "footprints": _footprints(reduced, placed, there, float(report["ground_z_m"])),
        "arrows": _arrows(reduced, shifts) if shifts is not None and len(shifts.at) else None,
        "paths": _paths(reduced, placed, report) if report["legs"] else None,
        "trust": _trust(out, reduced, report),
    }


# -- figures ------------------------------------------------------------------------------------------------------


def _edge_crops(best: Path, ortho: Picture, there: MapView, basemap: Basemap) -> list[Figure]:
    """Parts of the orthoimage with the map's edges over them, where the map has most of them."""
    import cv2

    epsg, side = there.grid.epsg, 360
    gsd = max(0.5 * there.grid.gsd_m, 0.5 * basemap.native_gsd_m, 0.1)
    overview = view_grid(epsg, there.grid.bounds, 400)
    seen = ortho.on(overview).seen.astype(np.float32)
    size = max(3, int(side * gsd / overview.gsd_m))
    if size > 2 * max(seen.shape):  # a map of huge pixels: no such part lies in it, and summing over it takes minutes
        return []
    edges = map_edges(there.on(overview)).astype(np.float32) * seen
    full = cv2.boxFilter(seen, -1, (size, size), borderType=cv2.BORDER_CONSTANT) > 0.9
    score = cv2.boxFilter(edges, -1, (size, size), borderType=cv2.BORDER_CONSTANT) * full
    figures: list[Figure] = []
    while len(figures) < 3 and score.size and score.max() > 0.01:
        r, c = np.unravel_index(int(score.argmax()), score.shape)
        window = BoundingBox.around_points(overview.to_ground([float(c), float(r)]), 0.5 * side * gsd)
        part = MapView.read(basemap, view_grid(epsg, window, side, gsd))
        picture = product_picture(best, part.grid)
        picture.rgb[map_edges(part)] = _EDGE
        scale_bar(picture)
        figures.append(Figure("", data_uri(picture.rgb, 88), ""))
        score[max(0, r - size) : r + size, max(0, c - size) : c + size] = 0
    return figures


def _footprints(reduced: Picture, placed: Sequence[PlacedFrame], there: MapView | None, ground_z_m: float) -> Figure:
    """Each vehicle's footprints on the map, or on the orthoimage where there is none."""
    if there is None:
        picture, on = Picture(reduced.rgb.copy(), reduced.seen, reduced.grid), "the orthoimage"
    else:
        picture, on = there.on(reduced.grid).picture(), "the map"
    for i, vehicle in enumerate(dict.fromkeys(p.frame.vehicle for p in placed)):
        own = [p for p in placed if p.frame.vehicle == vehicle]
        step = max(1, len(own) // 60)
        rings = [ring for p in own[::step] if len(ring := footprint(p.camera, ground_z_m))]
        colour = PALETTE[i % len(PALETTE)]
        fill_polygons(picture, rings, colour, 0.03)
        draw_lines(picture, rings, colour, 1, closed=True)
    scale_bar(picture)
    return Figure("Footprints", data_uri(picture.rgb), f"What each picture sees, on {on}; one colour a vehicle.")


def _arrows(reduced: Picture, shifts: Moved) -> Figure:
    picture = pale(reduced, 0.8)
    size = shifts.size_m
    usual = max(float(np.percentile(size, 90)), 1e-3)
    stretch = 18.0 * picture.grid.gsd_m / usual
    draw_arrows(picture, shifts.at, shifts.at + shifts.shift * stretch, _ARROW)
    scale_bar(picture)
    text = (
        f"Where {len(shifts.at)} of {shifts.blocks} blocks of the orthoimage are found on the map, shifts drawn "
        f"{stretch:,.0f} times as long: median {np.median(size):.2f} m, 95 % below {np.percentile(size, 95):.2f} m. "
        "No arrow: changed since the map was made, or without texture."
    )
    return Figure("Displacement against the map", data_uri(picture.rgb), text)


def _trust(out: Path, reduced: Picture, report: Mapping[str, Any]) -> Figure | None:
    path = out / "confidence.tif"
    if not report.get("trust") or not path.exists():
        return None
    return Figure("Where not to trust the map", data_uri(trust_picture(path, reduced).rgb), sentences(report))


def _paths(reduced: Picture, placed: Sequence[PlacedFrame], report: Mapping[str, Any]) -> Figure:
    picture = pale(reduced, 0.7)
    by_vehicle: dict[str, list[PlacedFrame]] = {}
    for p in placed:
        by_vehicle.setdefault(p.frame.vehicle, []).append(p)
    for own in by_vehicle.values():
        draw_lines(picture, [np.array([p.camera.nadir for p in own])], (150, 155, 165), 1)
    for leg in report["legs"]:
        own = by_vehicle.get(leg["vehicle"], [])[leg["first"] : leg["last"] + 1]
        colour, width = (_LEGS[leg["state"]], _LEG_WIDTHS[leg["state"]]) if _on_map(report) else (PALETTE[0], 3)
        draw_lines(picture, [np.array([p.camera.nadir for p in own])] if own else [], colour, width)
    scale_bar(picture)
    text = (
        "Green, thin: matched to the map. Orange, wider: carried by the others. Dark red, widest: failed. "
        "Light grey: turns."
        if _on_map(report)
        else "Straight legs of the flights; grey: turns."
    )
    return Figure("Legs", data_uri(picture.rgb), text)


# -- words --------------------------------------------------------------------------------------------------------


def _verdict(report: Mapping[str, Any], placed: Sequence[PlacedFrame], shifts: Moved | None) -> dict[str, str]:
    """How far the map can be trusted, in one sentence and one colour."""
    sigma = [p.sigma_m for p in placed if np.isfinite(p.sigma_m)]
    usual = float(np.median(sigma)) if sigma else float("nan")
    fine = sum(p.stage == "fine" for p in placed)
    if report["until"] == "realtime" or report["refine"] == "none":
        return {
            "kind": "rough",
            "text": f"Rough picture from recorded positions; expect errors of about {usual:.0f} m (one sigma an axis).",
        }
    if report.get("control"):
        return _control_verdict(report["control"], _expected(sigma), report.get("control_offset_m"))
    if not fine:
        text = "Consistent in itself, but placed where the drones' receivers say, not on a map"
        return {"kind": "rough", "text": f"{text}; expect errors of about {usual:.1f} m (one sigma an axis)."}
    text = (
        f"Lies on the pre-disaster map; expected error against it {_expected(sigma)}, of open ground, "
        "computed from how well pictures and map fit together"
    )
    if shifts is not None and len(shifts.at) >= 10:
        median = float(np.median(shifts.size_m))
        text += (
            f". Blocks of the orthoimage differ from the map by {median:.2f} m (median), which is usually more, "
            "because roofs and trees count, too, and lean differently in the two"
        )
        if median > 3 * max(usual, 0.3):
            return {"kind": "doubt", "text": text + ". The two disagree: check the pictures below before use."}
    offset = report.get("map_offset_m")
    if offset is not None:
        away, sigma = math.hypot(offset["east"], offset["north"]), offset["sigma"]
        text += f". The map itself lies {away:.1f} m from where the receivers say, which are good to {sigma:.1f} m"
        if offset["doubted"]:
            return {"kind": "doubt", "text": text + ": one of the two is wrong, see below."}
    checked = report.get("checkpoints")
    text += (
        ". These are errors against the map; only surveyed points show the error against the ground"
        if checked is None
        else f". Against the ground: {checked['statement']}"
    )
    return {"kind": "good" if fine >= 0.9 * len(placed) else "rough", "text": text + "."}


def _expected(sigma_m: Sequence[float]) -> str:
    """One sigma of a place on the map, and how it differs from picture to picture."""
    if not sigma_m:
        return "an unknown distance"
    low, usual, high = np.quantile(sigma_m, [0.05, 0.5, 0.95])
    text = f"{usual:.2f} m (one sigma an axis"
    if f"{low:.2f}" != f"{high:.2f}":
        text += f"; {low:.2f} to {high:.2f} m in nine of ten pictures"
    return text + ")"


def _control_verdict(control: Mapping[str, Any], expected: str, offset: Mapping[str, Any] | None) -> dict[str, str]:
    """The verdict on a map that surveyed points placed; `offset`: of these against the receivers."""
    count, shift = control["points"], control["shift_m"]
    points = "one surveyed point" if count == 1 else f"{count} surveyed points"
    text = (
        f"Placed on {points}, which moved it by {math.hypot(shift['east'], shift['north']):.2f} m "
        f"({shift['east']:+.2f} east, {shift['north']:+.2f} north); expected error {expected}"
    )
    if count > 1:
        text += f"; {control['residual_rms_m']:.2f} m (rms) are left at the points"
    if offset is not None and offset["doubted"]:
        away = math.hypot(offset["east"], offset["north"])
        text += f". The points lie {away:.1f} m from where the receivers say, which are good to {offset['sigma']:.1f} m"
        return {"kind": "doubt", "text": text + ": one of the two is wrong."}
    return {"kind": "rough" if control["left_out"] or count < 3 else "good", "text": text + "."}


def _facts(report: Mapping[str, Any], placed: Sequence[PlacedFrame], shifts: Moved | None) -> list[tuple[str, str]]:
    from pyproj import CRS

    frames, gsd, days = report["frames"], float(report["gsd_m"]), _days(placed)
    facts = [
        (str(report["epsg"]), f"EPSG code: {CRS.from_epsg(report['epsg']).name}"),
        *([(days, "taken")] if days else []),
        (f"{frames['used']:,} of {frames['input']:,}", "pictures mapped"),
        (str(len(report["vehicles"])), "vehicle" if len(report["vehicles"]) == 1 else "vehicles"),
        (f"{gsd * 100:.1f} cm" if gsd < 1 else f"{gsd:.2f} m", "ground pixel"),
    ]
    area = float(report["area_ha"])
    facts.append((f"{area:,.1f} ha" if area < 1000 else f"{area / 100:,.1f} km²", "mapped"))
    if shifts is not None and len(shifts.at):
        facts.append((f"{np.median(shifts.size_m):.2f} m", "blocks off the map (median, roofs too)"))
    checked = report.get("checkpoints")
    if checked is not None:
        facts.append((f"{checked['rmse_h_m']:.2f} m", f"RMSE horizontal at {checked['checkpoints']} checkpoints"))
    return [*facts, (f"{report['wall_s']:.0f} s", "to make"), (f"{report['peak_rss_mb']:,.0f} MB", "memory")]


def _days(placed: Sequence[PlacedFrame]) -> str:
    """First and last day of the pictures' times; empty where none is known."""
    times = [text[:10] for p in placed if (text := iso_time(p.frame.time_s))]
    if not times:
        return ""
    first, last = min(times), max(times)
    return first if first == last else f"{first} to {last}"


def _on_map(report: Mapping[str, Any]) -> bool:
    """Whether the pictures were to be found on a map: without that, no leg has failed at it."""
    return bool(report["basemap"]) and report["until"] == "fine"


def _leg_summary(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for vehicle in report["vehicles"]:
        legs = [leg for leg in report["legs"] if leg["vehicle"] == vehicle["id"]]
        sigmas = [leg["sigma_m"] for leg in legs if leg["sigma_m"] is not None]
        rows.append(
            {
                "vehicle": vehicle,
                "legs": [{"state": leg["state"], "confidence": leg["confidence"] or 0.0} for leg in legs],
                "sigma_m": float(np.median(sigmas)) if sigmas else None,
            }
        )
    return rows


# -- charts (SVG) --------------------------------------------------------------------------------------------------

_STAGE_COLOURS = {
    "load": "#bbbbbb",
    "realtime": "#0072b2",
    "coarse": "#009e73",
    "fine": "#e69f00",
    "final": "#882255",
}
_WIDTH, _HEIGHT, _LEFT, _BASE = 640, 220, 46, 190


def fields_of_view(vehicles: Sequence[Mapping[str, Any]]) -> str | None:
    """Each vehicle's field of view with a bar of two sigma either way, an SVG; None if nothing was estimated."""
    known = [v for v in vehicles if v["fov_deg"] is not None and v["fov_sigma_deg"] is not None]
    if not known:
        return None
    fov = np.array([v["fov_deg"] for v in known])
    spread = np.minimum(2 * np.array([v["fov_sigma_deg"] for v in known]), 30.0)
    low, high = float((fov - spread).min()), float((fov + spread).max())
    room = max(1.0, 0.1 * (high - low))
    low, high = low - room, high + room

    def y(value: float) -> float:
        return _BASE - (value - low) / (high - low) * (_BASE - 14)

    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="fields of view">']
    step = _round_step((high - low) / 4)
    for tick in np.arange(np.ceil(low / step) * step, high, step):
        parts.append(f'<line x1="{_LEFT}" x2="{_WIDTH}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" class="grid"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}°</text>')
    gap = (_WIDTH - _LEFT) / len(known)
    for i, (vehicle, value, wide) in enumerate(zip(known, fov, spread, strict=True)):
        x = _LEFT + (i + 0.5) * gap
        colour = f"rgb{PALETTE[i % len(PALETTE)]}" if len(known) <= 16 else f"rgb{PALETTE[0]}"
        parts.append(
            f'<g stroke="{colour}" fill="{colour}"><line x1="{x:.1f}" x2="{x:.1f}" y1="{y(value - wide):.1f}" '
            f'y2="{y(value + wide):.1f}" stroke-width="2"/><circle cx="{x:.1f}" cy="{y(value):.1f}" r="3.5"/></g>'
        )
        if len(known) <= 16:
            name, most = str(vehicle["id"]), max(4, int(gap / 7))
            shown = escape(name if len(name) <= most else "…" + name[-(most - 1) :])
            parts.append(f'<text x="{x:.1f}" y="{_BASE + 20}" text-anchor="middle">{shown}</text>')
    if len(known) > 16:
        parts.append(f'<text x="{_LEFT}" y="{_BASE + 20}">{len(known)} vehicles</text>')
    return "".join([*parts, "</svg>"])


def time_bars(stages: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the page needs for two stacked bars, wall and CPU seconds, and their legend."""
    colours = [_colour(str(stage["name"]), i) for i, stage in enumerate(stages)]
    bars = []
    for key, title in (("wall_s", "time"), ("cpu_s", "processor time")):
        seconds = [float(stage[key]) for stage in stages]
        total = sum(seconds)
        parts = [{"share": 100.0 * s / total if total else 0.0, "colour": c} for s, c in zip(seconds, colours)]
        bars.append({"title": title, "total": total, "parts": parts})
    keys = ("name", "wall_s", "cpu_s")
    return {"bars": bars, "legend": [{"colour": c} | {k: s[k] for k in keys} for s, c in zip(stages, colours)]}


def _colour(name: str, index: int) -> str:
    base = next((c for prefix, c in _STAGE_COLOURS.items() if name.startswith(prefix)), "#555")
    return base + ("", "cc", "99", "bb")[index % 4] if name.startswith("final") else base


def _round_step(value: float) -> float:
    unit = 10.0 ** np.floor(np.log10(max(value, 1e-6)))
    return float(next(s for s in (1, 2, 5, 10) if s * unit >= value) * unit)


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

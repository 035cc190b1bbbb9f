"""A picture of a plan: area, no-fly zones, each vehicle's legs and ways in its own colour."""

import io
from typing import Any

import numpy as np

from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.plan import Plan, Sortie
from orthoswarm.planning.area.area import Area

_INCHES = 10.0  # of the longer side
_LABELS = 24  # vehicles that are named in the legend


def draw(plan: Plan, area: Area | None) -> bytes:
    """The plan as a PNG.

    Legs are thick, ways thin and dashed, starts dots, gaps red crosses; axes are metres from the lower left corner.

    Args:
        plan: what is drawn.
        area: ground and no-fly zones; None along given lines.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    grid = LocalGrid(plan.epsg)
    paths = {v.number: [_path(s, grid) for s in v.sorties] for v in plan.vehicles}
    everything = np.concatenate([p for rows in paths.values() for p in rows])
    if area is not None:
        west, south, east, north = area.ground.bounds
        everything = np.concatenate([everything, [[west, south], [east, north]]])
    corner = everything.min(0)
    width, height = np.maximum(everything.max(0) - corner, 1.0)
    scale = _INCHES / max(width, height)
    figure = Figure(figsize=(max(5.0, width * scale + 1.2), max(4.0, height * scale + 1.4)), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    if area is not None:
        _fill(axes, area.ground, corner, "#e4e9e2", "#8a9a86")
        _fill(axes, area.no_fly, corner, "#f4b6ae", "#c0392b")
    thick = float(np.clip(220.0 / np.sqrt(len(plan.vehicles) * max(1, len(everything))), 0.8, 2.4))
    for vehicle in plan.vehicles:
        colour = _colour(vehicle.number - 1, len(plan.vehicles))
        for sortie, path in zip(vehicle.sorties, paths[vehicle.number], strict=True):
            _flight(axes, sortie, path - corner, colour, thick)
        if len(plan.vehicles) <= _LABELS:
            at = _middle(vehicle.sorties[0], paths[vehicle.number][0]) - corner
            box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": colour, "linewidth": 0.8}
            axes.annotate(vehicle.id, at, fontsize=8, weight="bold", ha="center", va="center", bbox=box)
    for gap in plan.gaps:
        axes.plot(*(grid.to_grid(gap.lat_deg, gap.lon_deg) - corner), "x", color="red", markersize=5)
    axes.set_xlabel("metres east")
    axes.set_ylabel("metres north")
    axes.set_title(_title(plan), fontsize=9)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _title(plan: Plan) -> str:
    covered = "" if plan.covered_share is None else f", {100 * plan.covered_share:.2f} % covered"
    return (
        f"{plan.method}: {len(plan.vehicles)} vehicles at {plan.altitude_m:g} m{covered}\n"
        f"done after {plan.makespan_s / 60:.1f} min, longest path {plan.balance:.2f} x mean, "
        f"{sum(v.turns for v in plan.vehicles)} turns"
    )


def _path(sortie: Sortie, grid: LocalGrid) -> Any:
    lat = [sortie.home_lat_deg, *(w.lat_deg for w in sortie.waypoints)]
    lon = [sortie.home_lon_deg, *(w.lon_deg for w in sortie.waypoints)]
    return grid.to_grid(lat, lon)


def _middle(sortie: Sortie, path: Any) -> Any:
    """The middle of the longest leg."""
    ends = [k for k, point in enumerate(sortie.waypoints, start=1) if point.camera is False]
    longest = max(ends, key=lambda k: float(np.hypot(*(path[k] - path[k - 1]))))
    return 0.5 * (path[longest] + path[longest - 1])


def _flight(axes: Any, sortie: Sortie, path: Any, colour: Any, thick: float) -> None:
    axes.plot(*path.T, "--", color=colour, linewidth=0.4 * thick, alpha=0.8)
    for k, point in enumerate(sortie.waypoints, start=1):
        if point.camera is False:
            axes.plot(*path[k - 1 : k + 1].T, "-", color=colour, linewidth=thick, solid_capstyle="butt")
    axes.plot(*path[0], "o", color=colour, markersize=4, markeredgecolor="black", markeredgewidth=0.5)


def _fill(axes: Any, geometry: Any, corner: Any, face: str, edge: str) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for polygon in geometry.geoms:
        rings = [np.asarray(ring.coords)[:, :2] - corner for ring in (polygon.exterior, *polygon.interiors)]
        outline = Path.make_compound_path(*(Path(ring, closed=True) for ring in rings))
        axes.add_patch(PathPatch(outline, facecolor=face, edgecolor=edge, linewidth=0.6))


def _colour(index: int, count: int) -> Any:
    from matplotlib import colormaps

    if count <= 10:
        return colormaps["tab10"](index)
    # Neighbours in number are neighbours on the ground: golden steps keep their colours apart.
    return colormaps["hsv"]((index * 0.618034) % 1.0)

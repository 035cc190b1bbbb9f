"""Charts of the report as SVG: fields of view with their uncertainty, times of the stages as stacked bars."""

from collections.abc import Mapping, Sequence
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

PALETTE = [
    (0, 114, 178),
    (213, 94, 0),
    (86, 180, 233),
    (204, 121, 167),
    (0, 158, 115),
    (136, 0, 238),
    (85, 34, 0),
    (51, 51, 68),
    (187, 204, 119),
    (221, 0, 68),
]
"""Colours that stay apart on photographs and in print: five of Okabe and Ito's, and others that differ from all before
by at least 16 (CIE 1976), also as seen without red, green or blue cones (Machado and others 2009)."""

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


def times(stages: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
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

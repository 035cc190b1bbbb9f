"""`orthoswarm inspect`: the content of inputs, and what is suspicious."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthoswarm.export.json_values import json_text
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.errors import InputError
from orthoswarm.stores.addresses import path_of

if TYPE_CHECKING:
    from telemetry.ingest.ingest import Survey

_NAMED = 3
"""Pictures that are named for each reason why some cannot be used."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "Reads photos, videos (SEI, KLV, djmd, subtitles), geo.txt, CSV of poses and flight logs; changes nothing."
        "\n\nexample:\n  orthoswarm inspect photos flight.mp4 --picture tracks.png"
    )
    add = parser.add_argument
    add("inputs", nargs="+", type=path_of, metavar="INPUT", help="folders, photos, videos, logs, or their addresses")
    add(
        "--sei-layout", type=Path, action="append", default=[], metavar="FILE",
        help="TOML file that describes a private SEI message (docs/telemetry.md)",
    )  # fmt: skip
    add("--json", action="store_true", help="print one JSON document on stdout")
    add("--picture", type=Path, metavar="PNG", help="write a picture of the tracks")
    add("--no-pictures", action="store_true", help="look at tags only, do not match pictures to confirm the yaw")


def run(args: argparse.Namespace) -> int:
    """Read the inputs and print the summary."""
    from gcs_plugin.cli.arguments import ProgressBars
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    from telemetry.ingest.ingest import LoadOptions, survey
    from telemetry.ingest.summary import summarise

    with ProgressBars() as progress:
        options = LoadOptions(decode=False, sei_layouts=tuple(args.sei_layout))
        found = survey(args.inputs, progress=progress, options=options)
        document = summarise(found, pictures=not args.no_pictures)
    if args.picture is not None:
        draw_tracks(found, args.picture)
        document["picture"] = str(args.picture)
    if args.json:
        print(json_text(document, 1))
    else:
        _tell(document)
    return 0 if document["sources"] or document["rejected"] else 1


def _tell(document: dict[str, Any]) -> None:
    """Print the document as tables."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    from telemetry.ingest.summary import one_line

    console = Console()
    for source in document["sources"]:
        console.print(f"\n[bold]{escape(one_line(source))}[/bold]")
        if source["vehicles"]:
            table = Table(
                Column("vehicle", overflow="fold"),
                "pictures",
                "legs",
                "length",
                Column("start, UTC", no_wrap=True),
                "end",
                "height",
                "pitch",
                box=None,
            )
            for v in source["vehicles"]:
                table.add_row(
                    escape(v["id"]), str(v["frames"]), str(v["legs"]), f"{v['length_m']:.0f} m",
                    *_span(v["start"], v["end"]), _range(v.get("height_m"), "m"), _range(v.get("pitch_deg"), "°"),
                )  # fmt: skip
            console.print(table)
            for v in source["vehicles"]:
                if v.get("fields"):
                    console.print(f"  {escape(v['id'])}: {escape(_origins(v['fields']))}", style="dim")
        for finding in source["findings"]:
            mark = "[yellow]![/yellow]" if finding["severity"] == "warning" else "[dim]i[/dim]"
            console.print(f"  {mark} [bold]{finding['code']}[/bold] {escape(finding['message'])}")
    if document["rejected"]:
        console.print(f"\n[bold]{len(document['rejected'])} cannot be used[/bold]")
        named: dict[str, list[str]] = {}
        for rejection in document["rejected"]:
            detail = f" ({rejection['detail']})" if "detail" in rejection else ""
            named.setdefault(rejection["reason"], []).append(f"{rejection['image']}{detail}")
        for reason, images in named.items():
            rest = f" and {len(images) - _NAMED} more (--json lists all)" if len(images) > _NAMED else ""
            console.print(f"  [red]x[/red] {escape(', '.join(images[:_NAMED]))}{rest}: {escape(reason)}")
    for finding in document["findings"]:
        console.print(f"[yellow]![/yellow] {escape(finding['message'])}")


def _span(start: str | None, end: str | None) -> tuple[str, str]:
    """First and last time in seconds; the last one without the date where that is the first one's."""
    first, last = (time[:19].replace("T", " ") if time else "?" for time in (start, end))
    return first, last[11:] if start and last[:10] == first[:10] else last


def _origins(fields: dict[str, str]) -> str:
    """Which fields come from which source, those of one source together."""
    names: dict[str, list[str]] = {}
    for name, source in fields.items():
        names.setdefault(source, []).append("field of view" if name == "fov_hint" else name.replace("_", " "))
    return "; ".join(f"{', '.join(some)} from {source}" for source, some in names.items())


def _range(pair: list[float] | None, unit: str) -> str:
    if pair is None:
        return "?"
    low, high = pair
    low, high = round(low) + 0, round(high) + 0
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"


Row = tuple[float, float, float | None]
"""Latitude, longitude in degrees, yaw in radians."""


def draw_tracks(found: "Survey", path: Path) -> None:
    """A picture of all vehicles' tracks, with an arrow for the yaw of some pictures; a panel for each area.

    Raises:
        InputError: there is no position.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    areas = _areas(_tracks(found))
    if not areas:
        raise InputError("there is no position to draw; leave --picture out")
    columns = min(3, len(areas))
    rows = -(-len(areas) // columns)
    figure, panels = plt.subplots(
        rows, columns, figsize=(9 if columns == 1 else 6 * columns, 9 if columns == 1 else 6 * rows),
        layout="constrained", squeeze=False,
    )  # fmt: skip
    for axes, area in zip(panels.flat, areas):
        _draw_area(axes, area)
    for axes in panels.flat[len(areas) :]:
        axes.axis("off")
    figure.suptitle("tracks, with the pictures' yaw as arrows")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.part.png")
    figure.savefig(temporary, dpi=110)
    plt.close(figure)
    temporary.replace(path)


def _tracks(found: "Survey") -> dict[str, list[Row]]:
    """Positions and yaw of each vehicle."""
    rows: dict[str, list[Row]] = {}
    for source in found.sources:
        for frame in source.frames:
            rows.setdefault(frame.vehicle, []).append((frame.fix.lat_deg, frame.fix.lon_deg, frame.fix.yaw_rad))
        for vehicle, samples in source.tracks.items():
            placed = [
                (s.lat_deg, s.lon_deg, None if s.yaw_deg is None else math.radians(s.yaw_deg))
                for s in samples
                if s.lat_deg is not None and s.lon_deg is not None
            ]
            if placed:
                rows.setdefault(vehicle, []).extend(placed)
    return rows


def _areas(tracks: dict[str, list[Row]], apart_deg: float = 0.2) -> list[dict[str, list[Row]]]:
    """Vehicles grouped by where they start."""
    areas: list[dict[str, list[Row]]] = []
    for vehicle, rows in tracks.items():
        for area in areas:
            lat, lon, _ = next(iter(area.values()))[0]
            if abs(rows[0][0] - lat) < apart_deg and abs(wrap_deg(rows[0][1] - lon)) < apart_deg:
                area[vehicle] = rows
                break
        else:
            areas.append({vehicle: rows})
    return areas


def _draw_area(axes: Any, tracks: dict[str, list[Row]]) -> None:
    import numpy as np

    from telemetry.samples.course import local_metres

    every = [row for rows in tracks.values() for row in rows]
    ground = local_metres([r[0] for r in every], [r[1] for r in every])
    extent = max(float(np.ptp(ground, axis=0).max()), 10.0)
    at = 0
    for vehicle, rows in tracks.items():
        own = ground[at : at + len(rows)]
        at += len(rows)
        (line,) = axes.plot(own[:, 0], own[:, 1], ".-", lw=0.8, ms=3, label=f"{vehicle} ({len(rows)})")
        some = range(0, len(rows), max(1, len(rows) // 60))
        arrows = [(own[i], yaw) for i in some if (yaw := rows[i][2]) is not None]
        if arrows:
            tails = np.array([tail for tail, _ in arrows])
            heads = 0.02 * extent * np.array([[np.sin(yaw), np.cos(yaw)] for _, yaw in arrows])
            axes.quiver(*tails.T, *heads.T, angles="xy", scale_units="xy", scale=1, width=0.002, color=line.get_color())
    axes.set_aspect("equal", "datalim")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    if len(tracks) <= 24:
        axes.legend(fontsize=8)
    axes.grid(alpha=0.3)

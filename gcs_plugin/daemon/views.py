"""The daemon's state for the API: frames, vehicles, legs and layers as JSON values."""

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from gcs_plugin.daemon.intake.can_reader import CanReader
from gcs_plugin.daemon.intake.picture_sources import Source
from gcs_plugin.daemon.layers.layers import Layer, drawn_bounds
from gcs_plugin.daemon.settings import VehicleSettings
from gcs_plugin.daemon.store.journal import Journal, packed, unpacked
from orthoswarm.export.product_files import iso_time
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import LocalGrid
from orthoswarm.raster.basemap import Basemap


def frame_rows(
    journal: Journal, vehicle: str | None = None, since: float | None = None, limit: int | None = None
) -> list[dict[str, Any]]:
    """Frames in the order of arrival."""
    where, values = ["1"], list[Any]()
    if vehicle is not None:
        where.append("vehicle = ?")
        values.append(packed(vehicle))
    if since is not None:
        where.append("time >= ?")
        values.append(since)
    query = f"SELECT * FROM frames WHERE {' AND '.join(where)} ORDER BY seq LIMIT ?"
    return [_frame_row(row) for row in journal.rows(query, [*values, -1 if limit is None else limit])]


def _frame_row(row: Any) -> dict[str, Any]:
    pose = json.loads(row["pose"])
    return {
        "seq": row["seq"], "image": unpacked(row["image"]), "vehicle": unpacked(row["vehicle"]),
        "time": iso_time(row["time"]), "stage": row["stage"], "sigma_m": row["sigma"], "reason": row["reason"],
        "sortie": row["sortie"], "on_map": bool(row["drawn"]) and row["reason"] is None,
        "width": row["width"], "height": row["height"], **pose,
    }  # fmt: skip


# -- vehicles ---------------------------------------------------------------------------------------------------------


def vehicle_rows(
    journal: Journal,
    named: Sequence[VehicleSettings],
    sources: Iterable[Source],
    linked: Mapping[str, dict[str, Any]],
    *,
    buses: Iterable[CanReader] = (),
    origins: Mapping[str, Mapping[str, str]] | None = None,
) -> list[dict[str, Any]]:
    """All vehicles that were heard, that sent pictures, or that are configured.

    Args:
        journal: of the workspace. named: with names given by the operator. sources: of pictures.
        linked: id -> the vehicle's state on its link. buses: CAN buses of vehicles.
        origins: id -> sources of the vehicle's newest pose.

    Returns:
        A row per vehicle, each with `id` and `name` (empty if none was given).
    """
    documents = {row["id"]: row for row in _senders(journal)}
    for name, heard in linked.items():
        documents[name] = documents.get(name, {"sortie": 1, "frames": {}}) | heard
    for source in sources:
        documents.setdefault(source.vehicle, {"id": source.vehicle, "state": "waiting", "frames": {}, "sortie": 1})
        documents[source.vehicle]["pictures"] = source.document()
    for bus in buses:
        documents.setdefault(bus.vehicle, {"id": bus.vehicle, "state": "waiting", "frames": {}, "sortie": 1})
        documents[bus.vehicle]["can"] = bus.document()
    for name, origin in (origins or {}).items():
        if name in documents:
            documents[name]["poses"] = dict(origin)
    names = {v.id: v.name for v in named}
    return [row | {"name": names.get(row["id"], "")} for row in documents.values()]


def _senders(journal: Journal) -> Iterable[dict[str, Any]]:
    """Vehicles in the journal, with their counts of frames and where the last picture was taken."""
    rows = journal.rows(
        "SELECT v.id, v.sortie, COUNT(f.seq) AS frames, SUM(f.stage = 'fine') AS fine,"
        " SUM(f.stage = 'coarse') AS coarse, SUM(f.stage = 'rejected') AS rejected, MAX(f.seq) AS last"
        " FROM vehicles v LEFT JOIN frames f ON f.vehicle = v.id GROUP BY v.id ORDER BY v.rowid"
    )
    latest = journal.rows(
        "SELECT seq, time, arrived, pose FROM frames WHERE seq IN (SELECT MAX(seq) FROM frames GROUP BY vehicle)"
    )
    last = {row["seq"]: row for row in latest}
    for row in rows:
        name = unpacked(row["id"])
        document: dict[str, Any] = {"id": name, "state": "pictures", "sortie": row["sortie"]}
        document["frames"] = {k: row[k] or 0 for k in ("frames", "fine", "coarse", "rejected")}
        if row["last"] in last:
            pose = json.loads(last[row["last"]]["pose"])
            document |= {key: pose.get(key) for key in ("lat_deg", "lon_deg", "height_m")}
            newest = last[row["last"]]
            document |= {"heading_deg": pose.get("yaw_deg"), "last_frame": iso_time(newest["time"])}
            document["came_s"] = round(max(0.0, time.time() - newest["arrived"]), 1)
        yield document


# -- legs -------------------------------------------------------------------------------------------------------------


def leg_features(journal: Journal) -> dict[str, Any]:
    """The legs as GeoJSON lines with state, confidence, sigma and stage: coarse in flight, fine once refined."""
    features = []
    refined = journal.rows("SELECT vehicle, sortie, detail FROM solutions ORDER BY vehicle, sortie")
    done = {(row["vehicle"], row["sortie"]) for row in refined}
    flying = [
        row
        for row in journal.rows("SELECT vehicle, sortie, detail FROM coarse ORDER BY vehicle, sortie")
        if (row["vehicle"], row["sortie"]) not in done
    ]
    for stage, rows in (("fine", refined), ("coarse", flying)):
        for row in rows:
            legs = [leg for leg in json.loads(row["detail"])["legs"] if leg.get("line")]
            for number, leg in enumerate(legs, start=1):
                about = {"vehicle": unpacked(row["vehicle"]), "sortie": row["sortie"], "leg": number, "stage": stage}
                about |= {key: leg[key] for key in ("state", "confidence", "sigma_m")}
                geometry = {"type": "LineString", "coordinates": leg["line"]}
                features.append({"type": "Feature", "properties": about, "geometry": geometry})
    return {"type": "FeatureCollection", "features": features}


# -- layers -----------------------------------------------------------------------------------------------------------


def layer_rows(layers: Mapping[str, Layer], basemap: Basemap | None) -> list[dict[str, Any]]:
    """The layers with versions and bounds, the basemap first, `best` last."""
    rows = []
    if basemap is not None:
        rows.append(_layer_row("basemap", 1, basemap.epsg, basemap.bounds, basemap.native_gsd_m))
    shown: list[tuple[int, int | None, BoundingBox, float | None]] = []
    for name, layer in layers.items():
        with layer.reading() as canvas:
            version = 0 if canvas is None else canvas.version
            bounds = None if canvas is None else drawn_bounds(canvas)
            epsg, gsd = (None, None) if canvas is None else (canvas.grid.epsg, canvas.grid.gsd_m)
        rows.append(_layer_row(name, version, epsg, bounds, gsd))
        if bounds is not None:
            shown.append((version, epsg, bounds, gsd))
    if shown:
        bounds = BoundingBox.around([b for _, _, b, _ in shown])
        rows.append(_layer_row("best", sum(v for v, *_ in shown), shown[0][1], bounds, shown[0][3]))
    else:
        rows.append(_layer_row("best", 0, None, None, None))
    return rows


def _layer_row(
    name: str, version: int, epsg: int | None, bounds: BoundingBox | None, gsd_m: float | None
) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": name, "version": version, "empty": bounds is None, "epsg": epsg, "gsd_m": gsd_m, "bounds": None,
        "tiles": f"/tiles/{name}/{{z}}/{{x}}/{{y}}.webp", "maxzoom": 22,
    }  # fmt: skip
    if bounds is not None and epsg is not None:
        west, south, east, north = bounds
        ring = LocalGrid(epsg).to_geographic([[west, south], [west, north], [east, south], [east, north]])
        low, high = ring.min(0), ring.max(0)
        row["bounds"] = [float(low[1]), float(low[0]), float(high[1]), float(high[0])]
    return row

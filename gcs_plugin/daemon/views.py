"""The daemon's state for the API: frames, vehicles, legs and layers as JSON values."""

import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from gcs_plugin.daemon.intake.can_reader import CanReader
from gcs_plugin.daemon.intake.picture_sources import PictureSource
from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.layers.layers import drawn_bounds
from gcs_plugin.daemon.layers.web_tiles import TileServer
from gcs_plugin.daemon.store import frame_rows, sortie_rows
from gcs_plugin.daemon.store.frame_rows import POSE_KEYS, FrameRow, Whose
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.sortie_rows import REFINED
from gcs_plugin.daemon.vehicle_names import VehicleRow
from gcs_plugin.daemon.vehicles import VehicleLinks
from orthoswarm.export.product_files import frame_row, iso_time
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.earth import DEGREE_M
from orthoswarm.model.geo import LocalGrid
from orthoswarm.trajectory.legs import split_legs
from telemetry.live.live_poses import LinkPoses

_MOST_LIVE: Final = 5000  # pictures in flight whose legs are told, the newest


class Views:
    """The daemon's state as JSON values."""

    def __init__(
        self, journal: Journal, links: VehicleLinks, *, tiles: TileServer, sources: Sequence[PictureSource],
        buses: Sequence[CanReader], poses: LinkPoses, solutions: Path,
    ) -> None:  # fmt: skip
        """Views of a journal's workspace; `solutions`: the folder of its solution files."""
        self._journal, self._links, self._tiles = journal, links, tiles
        self._sources, self._buses, self._poses, self._solutions = sources, buses, poses, solutions

    def frames(
        self, vehicle: str | None = None, since: float | None = None, limit: int | None = None, *, poses: bool = False
    ) -> list[dict[str, Any]]:
        """Frames in the order of arrival, those that were taken at a time (UTC epoch seconds) or later.

        poses: with their grid and homography, see `POSE_KEYS`.
        """
        rows = frame_rows.arrived_frames(self._journal, vehicle, since, limit)
        if not poses:
            return [_frame(row) for row in rows]
        refined = self._refined_poses({(row.vehicle, row.sortie) for row in rows if row.stage in REFINED})
        return [_frame(row) | refined.get((row.vehicle, row.image), row.placed.get("pose", {})) for row in rows]

    def _refined_poses(self, wanted: Collection[Whose]) -> dict[tuple[str, str], dict[str, Any]]:
        """What `POSE_KEYS` names, of the refined frames of sorties, by vehicle and image."""
        poses: dict[tuple[str, str], dict[str, Any]] = {}
        area = self._journal.fact("area")
        for whose, path in sortie_rows.solution_paths(self._journal, "coarse", "solutions").items() if area else ():
            if whose not in wanted:
                continue
            solution = read_solution(self._solutions / path).solution
            for placed in solution.placed:
                row = frame_row(placed, LocalGrid(area["epsg"]), solution.ground_z_m)
                poses[whose[0], placed.frame.image] = {key: row[key] for key in POSE_KEYS if key in row}
        return poses

    def vehicles(self) -> list[VehicleRow]:
        """All vehicles that were heard, that sent pictures, or that are configured; see the HTTP API."""
        rows = {row["id"]: row for row in self._senders()}
        for heard in self._links.rows():
            rows[heard["id"]] = rows.get(heard["id"], {"sortie": 1, "frames": {}}) | heard
        for source in self._sources:
            rows.setdefault(source.vehicle, _waiting(source.vehicle))["pictures"] = source.document()
        for bus in self._buses:
            rows.setdefault(bus.vehicle, _waiting(bus.vehicle))["can"] = bus.document()
        for vehicle, origin in self._poses.origins().items():
            if vehicle in rows:
                rows[vehicle]["poses"] = dict(origin)
        for row in rows.values():
            row["name"] = self._links.names.title_of(row["id"])
        return list(rows.values())

    def _senders(self) -> Iterable[VehicleRow]:
        """Vehicles in the journal, with their counts of frames and where the last picture was taken."""
        found, newest = sortie_rows.senders(self._journal), frame_rows.newest_frames(self._journal)
        for sender in found:
            document: VehicleRow = {"id": sender.vehicle, "state": "pictures", "sortie": sender.sortie}
            document["frames"], document["last_seq"] = sender.frames, sender.last
            if sender.last in newest:
                last = newest[sender.last]
                document["lat_deg"], document["lon_deg"] = last.pose.get("lat_deg"), last.pose.get("lon_deg")
                document["height_m"], document["heading_deg"] = last.pose.get("height_m"), last.pose.get("yaw_deg")
                document["last_frame"] = iso_time(last.time_s)
                document["came_s"] = round(max(0.0, time.time() - last.arrived_s), 1)
            yield document

    def legs(self) -> dict[str, Any]:
        """The legs as GeoJSON lines with state, confidence, sigma and stage: coarse in flight, fine once refined."""
        refined = [("fine", row) for row in sortie_rows.placed_sorties(self._journal, "solutions")]
        features = []
        for stage, row in refined + [("coarse", row) for row in sortie_rows.coarse_only(self._journal)]:
            legs = [leg for leg in row.detail["legs"] if leg.get("line")]
            for number, leg in enumerate(legs, start=1):
                about = {"vehicle": row.vehicle, "sortie": row.sortie, "leg": number, "stage": stage}
                about |= {key: leg[key] for key in ("state", "confidence", "sigma_m")}
                geometry = {"type": "LineString", "coordinates": leg["line"]}
                features.append({"type": "Feature", "properties": about, "geometry": geometry})
        shown = {row.whose for _, row in refined}
        live = [] if self._tiles.basemap is None else frame_rows.unplaced_frames(self._journal, _MOST_LIVE)
        return {"type": "FeatureCollection", "features": features + _live_legs(live[::-1], shown)}

    def completions(self) -> list[dict[str, Any]]:
        """Completions of vehicles and their results."""
        return sortie_rows.completion_rows(self._journal)

    def layers(self) -> list[dict[str, Any]]:
        """The layers with versions and bounds, the basemap first, `best` last."""
        rows, basemap = [], self._tiles.basemap
        if basemap is not None:
            row = _layer_row("basemap", 1, basemap.epsg, basemap.bounds, basemap.native_gsd_m)
            rows.append(row | {"attribution": basemap.attribution})
        shown: list[tuple[int, int | None, BoundingBox, float | None]] = []
        for name, layer in self._tiles.layers.items():
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


def _live_legs(rows: Sequence[FrameRow], refined: Collection[Whose]) -> list[dict[str, Any]]:
    """Legs in flight by how their pictures (in the order of arrival) were placed, as GeoJSON lines."""
    flown: dict[Whose, list[FrameRow]] = defaultdict(list)
    for row in rows:
        if row.placed and (row.vehicle, row.sortie) not in refined:
            flown[row.vehicle, row.sortie].append(row)
    features = []
    for (vehicle, sortie), own in flown.items():
        path = np.array([[row.pose["lon_deg"], row.pose["lat_deg"]] for row in own])
        metres = DEGREE_M * (path - path[0]) * [np.cos(np.radians(path[0, 1])), 1.0]
        leg_of = split_legs(metres)
        for leg in range(int(leg_of.max()) + 1):
            members = np.flatnonzero(leg_of == leg)
            share = float(np.mean([own[i].placed["placed_by"] == "map" for i in members]))
            about = {
                "vehicle": vehicle, "sortie": sortie, "leg": leg + 1, "stage": "realtime", "confidence": share,
                "state": "matched" if share > 0.5 else "failed",
                "sigma_m": float(np.median([own[i].sigma_m or np.nan for i in members])),
            }  # fmt: skip
            line = {"type": "LineString", "coordinates": path[members[[0, -1]]].tolist()}
            features.append({"type": "Feature", "properties": about, "geometry": line})
    return features


def _waiting(vehicle: str) -> VehicleRow:
    return {"id": vehicle, "state": "waiting", "frames": {}, "sortie": 1}


def _frame(row: FrameRow) -> dict[str, Any]:
    by = "refined" if row.stage in REFINED else row.placed.get("placed_by")
    after_s = row.placed.get("first", row.placed).get("placed_after_s")
    return {
        "placed_by": by, "placed_after_s": after_s,
        "seq": row.seq, "image": row.image, "vehicle": row.vehicle, "time": iso_time(row.time_s), "stage": row.stage,
        "sigma_m": row.sigma_m, "reason": row.reason, "sortie": row.sortie,
        "on_map": row.drawn and row.reason is None, "width": row.size[0], "height": row.size[1], **row.pose,
    }  # fmt: skip


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

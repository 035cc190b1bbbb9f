"""The pictures of a finished map: frames.jsonl and report.json of a `mosaic` folder or of a daemon's workspace."""

import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from orthoswarm.coverage.missing_pictures import Exposure
from orthoswarm.coverage.view import View, picture_flaws
from orthoswarm.export.product_files import read_frames
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.raster.picture_file import PictureError, read_gray
from orthoswarm.raster.picture_quality import PictureQuality, picture_quality
from orthoswarm.stores.addresses import path_of


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFolder:
    """The pictures of a finished map."""

    epsg: int  # grid of the map
    ground_z_m: float  # level of the mapped ground, same datum as the cameras
    views: list[View]  # placed pictures
    rejected: list[Exposure]  # files that were not placed, with a time
    root: Path | None  # folder that names of pictures are relative to, None if the report does not state it
    warnings: list[str]


def read_map(folder: Path) -> MapFolder:
    """Read a map's pictures. Raises InputError: there is no frames.jsonl or report.json, or they cannot be used."""
    report, rows = _documents(folder)
    placed = [row for row in rows if row.get("stage") != "rejected"]
    if not placed:
        raise InputError(f"{folder} has no placed picture, so there is no coverage; make the map again")
    zones = sorted({int(row["epsg"]) for row in placed})
    if len(zones) > 1:
        raise InputError(f"{folder} has pictures in several grids (EPSG {zones}); make one map of each area")
    grid, level = LocalGrid(zones[0]), float(report.get("ground_z_m") or 0.0)
    views = _with_focal_sigma([View.of_row(row, level, grid) for row in placed], report.get("vehicles", []))
    rejected = [
        Exposure(str(row.get("vehicle", "")), datetime.fromisoformat(row["time"]).timestamp(), str(row["image"]))
        for row in rows
        if row.get("stage") == "rejected" and row.get("time")
    ]
    warnings = []
    unplaced = sum(not v.placed for v in views)
    if unplaced:
        warnings.append(f"{unplaced} of {len(views)} pictures have only recorded poses, which are not refined")
    unsure = sum(not math.isfinite(v.sigma_m) for v in views)
    if unsure:
        warnings.append(f"{unsure} pictures have no known position error and count nowhere as well seen")
    root = path_of(report["root"]) if report.get("root") else None
    return MapFolder(epsg=grid.epsg, ground_z_m=level, views=views, rejected=rejected, root=root, warnings=warnings)


def _documents(folder: Path) -> tuple[Mapping[str, Any], list[dict[str, Any]]]:
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        rows = list(read_frames(folder / "frames.jsonl"))
    except OSError as error:
        missing = Path(str(error.filename)).name
        raise InputError(
            f"{folder} has no readable {missing}; give the output folder of `orthoswarm mosaic` or a workspace"
        ) from None
    except ValueError as error:
        raise InputError(f"{folder} has a damaged report.json or frames.jsonl ({error}); make the map again") from None
    if not isinstance(report, dict):
        raise InputError(f"{folder / 'report.json'} is not the report of a map; make the map again")
    return report, rows


def _with_focal_sigma(views: Sequence[View], vehicles: Iterable[Mapping[str, Any]]) -> list[View]:
    """Views with the error of their vehicle's field of view, where the report has it."""
    sigma = {str(v.get("id")): v.get("fov_sigma_deg") for v in vehicles}
    out = []
    for view in views:
        degrees = sigma.get(view.vehicle)
        half = 0.5 * view.fov_rad
        # d(f)/f of f = (W/2) / tan(half): d(half) / (sin(half) cos(half))
        relative = 0.0 if degrees is None else math.radians(float(degrees)) / math.sin(2.0 * half)
        out.append(replace(view, focal_sigma=relative))
    return out


def with_flaws(
    views: Sequence[View], root: Path, progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[list[View], int]:
    """The views with the flaws of their pictures, which are decoded for it; and how many could not be read.

    views: placed pictures. root: folder that their names are relative to. progress: called with done and total.
    """

    def measured(view: View) -> PictureQuality | None:
        try:
            return picture_quality(read_gray(root / view.image))
        except (PictureError, ValueError):
            return None

    qualities: list[PictureQuality | None] = []
    with ThreadPoolExecutor(2) as pool:
        for quality in pool.map(measured, views):
            qualities.append(quality)
            progress(len(qualities), len(views))
    cameras: dict[tuple[str, int, int], list[int]] = defaultdict(list)
    order = np.lexsort(([v.image for v in views], [v.time_s or 0.0 for v in views]))
    for i in order.tolist():
        cameras[views[i].vehicle, views[i].lens.width, views[i].lens.height].append(i)
    out = list(views)
    for members in cameras.values():
        for i, flaws in zip(members, picture_flaws([qualities[i] for i in members]), strict=True):
            out[i] = replace(views[i], flaws=flaws)
    return out, sum(q is None for q in qualities)

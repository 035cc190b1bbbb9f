"""The files of a data set except its photos: basemap, reference, height models, masks, plan, true cameras."""

import csv
import json
import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.arrays import Array
from orthoswarm.model.geo import GroundGrid
from orthoswarm.twin.city.builder import ParkingPlace
from orthoswarm.twin.city.city import place_cars
from orthoswarm.twin.city.scene import TEXEL_M, WATER, Scene
from orthoswarm.twin.city.sunlight import change_season, lit_texture
from orthoswarm.twin.disaster import DamagedGround, collapse, debris_flow, flood, haze_opacity, zone_mask
from orthoswarm.twin.flights import TrueFlight
from orthoswarm.twin.presets import TwinSpec
from orthoswarm.twin.ray_marching import PreparedScene, make_stage, satellite_view
from orthoswarm.twin.site import Site, disaster_zones, light_of, map_lean


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file by way of a temporary one, so that it is complete or absent."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    part.write_bytes(data)
    os.replace(part, path)


def write_geotiff(path: Path, image: NDArray[Any], grid: GroundGrid) -> None:
    """Write a tiled GeoTIFF of (rows, columns, bands) or (rows, columns); it is complete or absent."""
    import rasterio

    bands = image[..., None] if image.ndim == 2 else image
    part = path.with_name(f".{path.name}.part")
    profile = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": bands.shape[2],
        "dtype": bands.dtype.name,
        "crs": f"EPSG:{grid.epsg}", "transform": grid.affine(), "tiled": True, "blockxsize": 512, "blockysize": 512,
        "compress": "deflate", "zlevel": 3,
    }  # fmt: skip
    if bands.dtype == np.uint8:
        profile["predictor"] = 2
    if bands.shape[2] >= 3:
        profile.update(photometric="RGB", interleave="pixel")
    with rasterio.open(part, "w", **profile) as file:
        file.write(np.moveaxis(bands, 2, 0))
    os.replace(part, path)


def write_basemap(spec: TwinSpec, scene: Scene, slots: list[ParkingPlace], path: Path, truth: Path) -> None:
    """Write the map before the disaster: other light, season and cars, leaning buildings; truth/basemap.json: lean."""
    import cv2

    before = scene.copy()
    place_cars(before, slots, spec.seed * 2 + 1, spec.cars)
    change_season(before, spec.seed)
    sun = light_of(spec, 0)
    lit = lit_texture(before, sun)
    stage = make_stage(before, lit, sun.direction(), sun.ambient, np.zeros((0, 0), np.float32))
    lean = map_lean(spec)
    image, grid = satellite_view(stage, lean, spec.map_gsd_m)
    image = cv2.GaussianBlur(image, (0, 0), 0.55)
    rng = np.random.default_rng([spec.seed, 71])
    haze = np.array([rng.uniform(4, 16), rng.uniform(5, 18), rng.uniform(8, 24)])
    gain = np.float32(rng.uniform(0.82, 0.95))
    for rows in range(0, grid.height, 512):  # in strips, for memory
        part = image[rows : rows + 512]
        part *= gain
        part += (haze + rng.normal(0.0, 2.2, part.shape[:2])[..., None]).astype(np.float32)
    write_geotiff(path, np.clip(image, 1, 255).astype(np.uint8), grid)
    write_atomic(truth / "basemap.json", json.dumps({"lean_east": lean[0], "lean_north": lean[1]}).encode())


def after_disaster(
    spec: TwinSpec, scene: Scene, slots: list[ParkingPlace], zones: dict[str, DamagedGround]
) -> PreparedScene:
    """The scene at the time of the flight, ready for rendering; the scene is changed in place."""
    place_cars(scene, slots, spec.seed * 2 + 2, spec.cars)
    haze = np.zeros((0, 0), np.float32)
    if "debris" in zones:
        debris_flow(scene, zones["debris"], spec.seed)
    if "water" in zones:
        flood(scene, zones["water"], spec.seed)
    if "collapse" in zones:
        collapse(scene, spec.seed)
    if "haze" in zones:
        haze = haze_opacity(scene, zones["haze"], spec.seed)
    sun = light_of(spec, 1)
    lit = lit_texture(scene, sun)
    return make_stage(scene, lit, sun.direction(), sun.ambient, haze)


def damaged_city(spec: TwinSpec) -> tuple[PreparedScene, Site]:
    """The city after the disaster, prepared for rendering, and its site."""
    site = Site.of(spec)
    scene, slots = site.build(spec)
    return after_disaster(spec, scene, slots, disaster_zones(spec, site)), site


def write_truth(spec: TwinSpec, stage: PreparedScene, zones: dict[str, DamagedGround], truth: Path) -> None:
    """Write the true orthoimage after the disaster, surface, bare ground, and masks: moving, disaster, open ground."""
    import cv2

    if (truth / "ground_mask.tif").exists():
        return
    s, size = stage.scene, spec.reference_gsd_m
    width, height = (round(n * TEXEL_M / size) for n in (s.grid.width, s.grid.height))
    grid = replace(s.grid, gsd_m=size, width=width, height=height)
    reference = cv2.resize(stage.levels[0], (grid.width, grid.height), interpolation=cv2.INTER_AREA)
    write_geotiff(truth / "reference.tif", np.asarray(reference), grid)
    write_geotiff(truth / "dsm.tif", s.dsm, s.cells)
    write_geotiff(truth / "dtm.tif", s.dtm, s.cells)
    moving = (s.kind[::2, ::2] == WATER).astype(np.uint8) * 255
    write_geotiff(truth / "moving_mask.tif", moving, s.cells)
    if zones:
        inside = np.logical_or.reduce([zone_mask(s, zone, name, spec.seed) for name, zone in zones.items()])
        write_geotiff(truth / "disaster_mask.tif", inside.astype(np.uint8) * 255, s.cells)
    tall = (s.above_ground() > 2.0).astype(np.uint8)
    still = cv2.dilate(tall, np.ones((5, 5), np.uint8)) == 0
    write_geotiff(truth / "ground_mask.tif", (still & (moving == 0)).astype(np.uint8) * 255, s.cells)


def write_plan(spec: TwinSpec, site: Site, path: Path) -> None:
    """Area and planned paths as GeoJSON."""
    plan = spec.plan

    def feature(kind: str, local: Array, **properties: Any) -> dict[str, Any]:
        places = site.grid.to_geographic(plan.to_grid(local, site.center))
        line = [[round(float(lon), 9), round(float(lat), 9)] for lat, lon in places]
        geometry = {"type": kind, "coordinates": [line] if kind == "Polygon" else line}
        return {"type": "Feature", "properties": properties, "geometry": geometry}

    features = [feature("Polygon", plan.outline(), role="area")]
    for v in range(plan.vehicles):
        path_of = {"role": "path", "vehicle": plan.vehicle_id(v), "height_m": plan.height_m}
        features.append(feature("LineString", plan.corners(v), **path_of))
    write_atomic(path, json.dumps({"type": "FeatureCollection", "features": features}, indent=1).encode())


def photo_name(vehicle: str, index: int) -> str:
    """Path of a picture relative to the photos folder."""
    return f"{vehicle}/DJI_{index + 1:04d}.JPG"


def write_frames(spec: TwinSpec, site: Site, flights: list[TrueFlight], path: Path) -> None:
    """The true cameras of all pictures as a table; angles are degrees from true north, heights over takeoff."""
    rows: list[list[object]] = []
    for flight in flights:
        geographic = site.grid.to_geographic(flight.position[:, :2])
        convergence = site.grid.convergence_rad(geographic[:, 0], geographic[:, 1])
        degrees = np.degrees(np.c_[flight.angles[:, 0] + convergence, flight.angles[:, 1:]])
        degrees[:, 0] = wrap_deg(degrees[:, 0])
        for i in range(0, len(flight.time_s), spec.every):
            moment = datetime.fromtimestamp(round(float(flight.time_s[i]), 3), UTC).isoformat(timespec="milliseconds")
            rows.append(
                [photo_name(flight.vehicle, i), flight.vehicle, moment.replace("+00:00", "Z")]
                + [f"{x:.4f}" for x in flight.position[i]]
                + [f"{x:.6f}" for x in degrees[i]]
                + [f"{np.degrees(flight.lens.fov_rad):.6f}", flight.lens.k1, flight.lens.k2, site.grid.epsg]
                + [flight.lens.width, flight.lens.height]
            )
    header = ["image", "vehicle", "time", "easting", "northing", "height", "yaw_deg", "pitch_deg", "roll_deg"]
    header += ["fov_deg", "k1", "k2", "epsg", "width_px", "height_px"]
    part = path.with_name(".frames.csv.part")
    with part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
    os.replace(part, path)

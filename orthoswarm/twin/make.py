"""Make a set of data: the map before the disaster, the photos after it, and the truth in a folder of its own."""

import csv
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.camera import Camera, rotation_from_angles
from orthoswarm.errors import InputError
from orthoswarm.geo import GroundGrid, LocalGrid, utm_epsg
from orthoswarm.twin.city import build_city, place_cars
from orthoswarm.twin.disaster import SIZES_M, Zone, debris_flow, flood, haze_opacity, zone_mask
from orthoswarm.twin.flight import Flight, fly
from orthoswarm.twin.light import Sun, change_season, lit_texture
from orthoswarm.twin.presets import TwinSpec
from orthoswarm.twin.record import Record, record
from orthoswarm.twin.render import Stage, lens_rays, make_stage, render, satellite_view
from orthoswarm.twin.scene import CELL_M, WATER, Scene, scene_grid
from orthoswarm.twin.sensor import Sensor
from orthoswarm.twin.tags import PhotoTags, with_tags

Progress = Callable[[str, int, int], None]
SEA_LEVEL_M = 512.0
"""Absolute altitude of the takeoff point, so that nobody takes absolute altitudes for heights."""


@dataclass(frozen=True, slots=True)
class TwinSet:
    """What was made.

    Attributes:
        folder: of the set.
        photos: pictures of the set; made: those rendered now (the others were there).
        vehicles: number of vehicles.
    """

    folder: Path
    photos: int
    made: int
    vehicles: int


def make_twin(
    spec: TwinSpec, folder: Path, *, workers: int = 1, progress: Progress | None = None, only: int | None = None
) -> TwinSet:
    """Make a set of data; pictures that are already there are kept, so that an interrupted run goes on.

    Layout: photos/<vehicle>/<name>.JPG, basemap.tif, plan.geojson; truth/ holds frames.csv, reference.tif, dsm.tif,
    dtm.tif, masks and manifest.json. The same spec gives the same bytes.

    Args:
        spec: what to make.
        folder: where to put it.
        workers: threads that render.
        progress: called with a stage's name, what is done and what there is to do.
        only: stop after this many new pictures (None: all).

    Raises:
        InputError: if the folder holds another set.
    """
    tell = progress or (lambda *_: None)
    truth = folder / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    _claim(truth / "manifest.json", spec)
    tell("city", 0, 1)
    site = _Site.of(spec)
    flights = [fly(spec.plan, spec.motion, site.center, v, spec.seed, spec.lens_k) for v in range(spec.plan.vehicles)]
    records = [record(flight, spec.noise, v, spec.seed) for v, flight in enumerate(flights)]
    scene, slots = site.build(spec)
    zone = _zone(spec, site)
    if not (folder / "basemap.tif").exists():
        tell("basemap", 0, 1)
        _write_basemap(spec, scene, slots, folder / "basemap.tif", truth)
    tell("disaster", 0, 1)
    stage = _after(spec, scene, slots, zone)
    _write_truth(spec, stage, zone, truth)
    _write_plan(spec, site, folder / "plan.geojson")
    _write_frames(spec, site, flights, truth / "frames.csv")
    total = spec.plan.vehicles * len(range(0, spec.plan.photos, spec.every))
    made = 0
    shots = _missing(spec, site, flights, records, folder)
    for made in _render_all(spec, stage, site.grid, list(shots)[:only], workers, tell):
        pass
    return TwinSet(folder, total, made, spec.plan.vehicles)


def _claim(manifest: Path, spec: TwinSpec) -> None:
    text = json.dumps(spec.parameters(), indent=1, sort_keys=True)
    if manifest.exists():
        if json.loads(manifest.read_text()) != json.loads(text):
            raise InputError(f"{manifest.parent.parent} holds a set with other parameters; choose another folder")
        return
    _replace(manifest, text.encode())


def _replace(path: Path, data: bytes) -> None:
    """Write whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    part.write_bytes(data)
    os.replace(part, path)


@dataclass(frozen=True, slots=True)
class _Site:
    """Where the set lies."""

    grid: LocalGrid
    center: tuple[float, float]
    heading_rad: float

    @classmethod
    def of(cls, spec: TwinSpec) -> "_Site":
        if spec.ground is not None:
            from orthoswarm.twin.photo_ground import ground_place

            epsg, center, _ = ground_place(spec.ground)
            return cls(LocalGrid(epsg), center, spec.plan.heading_rad)
        grid = LocalGrid(utm_epsg(spec.lat_deg, spec.lon_deg))
        east, north = np.round(grid.to_grid(spec.lat_deg, spec.lon_deg))
        return cls(grid, (float(east), float(north)), spec.plan.heading_rad)

    def build(self, spec: TwinSpec) -> tuple[Scene, list[Any]]:
        across, along = (0.5 * x + spec.margin_m for x in spec.plan.extent_m)
        c, s = abs(np.cos(spec.plan.heading_rad)), abs(np.sin(spec.plan.heading_rad))
        half = (float(across * c + along * s), float(across * s + along * c))
        if spec.ground is not None:
            from orthoswarm.twin.photo_ground import load_ground

            return load_ground(spec.ground, self.center, half), []
        return build_city(scene_grid(self.grid.epsg, self.center, *half), spec.seed, relief_m=spec.relief_m)


def _zone(spec: TwinSpec, site: _Site) -> Zone | None:
    if spec.disaster == "none":
        return None
    if spec.disaster not in SIZES_M:
        raise InputError(f"there is no disaster '{spec.disaster}'; choose none, {', '.join(SIZES_M)}")
    rng = np.random.default_rng([spec.seed, 53])
    across, along = SIZES_M[spec.disaster]
    extent = np.array(spec.plan.extent_m)
    # the long side of the zone lies along the long side of the area; small areas get a smaller zone
    shrink = min(1.0, 0.8 * extent.max() / max(across, along), 0.8 * extent.min() / min(across, along))
    lengthwise = spec.plan.heading_rad + (np.pi / 2 if extent[0] >= extent[1] else 0.0)
    if across > along:
        lengthwise += np.pi / 2
    offset = rng.uniform(-0.12, 0.12, 2) * extent
    east, north = spec.plan.to_grid(offset, site.center)
    angle = np.pi / 2 - lengthwise + rng.uniform(-0.25, 0.25)
    return Zone(float(east), float(north), across * shrink, along * shrink, float(angle))


def suns(seed: int) -> tuple[Sun, Sun]:
    """The light of the map and of the photos: two different hours."""
    rng = np.random.default_rng([seed, 61])
    first = rng.uniform(0.6, 1.0)
    azimuth = rng.uniform(1.6, 4.6)
    turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 1.6)
    return (
        Sun(float(azimuth), float(first), 0.45),
        Sun(float(azimuth + turn), float(rng.uniform(0.6, 1.05)), 0.45),
    )


def _sun(spec: TwinSpec, which: int) -> Sun:
    """The light of the map (0) or of the photos (1); a real orthoimage has shadows already, so they are weaker."""
    sun = suns(spec.seed)[which]
    return sun if spec.ground is None else replace(sun, ambient=0.72)


def map_lean(spec: TwinSpec) -> tuple[float, float]:
    """The basemap's lean (east, north), metres of shift per metre of height."""
    rng = np.random.default_rng([spec.seed, 67])
    size, azimuth = rng.uniform(0.2, 0.35), rng.uniform(0.0, 360.0)
    size = spec.lean if spec.lean is not None else size
    azimuth = np.radians(spec.lean_deg if spec.lean_deg is not None else azimuth)
    return float(size * np.sin(azimuth)), float(size * np.cos(azimuth))


def _write_basemap(spec: TwinSpec, scene: Scene, slots: list[Any], path: Path, truth: Path) -> None:
    import cv2

    before = scene.copy()
    place_cars(before, slots, spec.seed * 2 + 1, spec.cars)
    change_season(before, spec.seed)
    sun = _sun(spec, 0)
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
    _geotiff(path, np.clip(image, 1, 255).astype(np.uint8), grid)
    _replace(truth / "basemap.json", json.dumps({"lean_east": lean[0], "lean_north": lean[1]}).encode())


def _after(spec: TwinSpec, scene: Scene, slots: list[Any], zone: Zone | None) -> Stage:
    """The scene at the time of the flight; changes the scene in place."""
    place_cars(scene, slots, spec.seed * 2 + 2, spec.cars)
    haze = np.zeros((0, 0), np.float32)
    if zone is not None and spec.disaster == "debris":
        debris_flow(scene, zone, spec.seed)
    elif zone is not None and spec.disaster == "water":
        flood(scene, zone, spec.seed)
    elif zone is not None:
        haze = haze_opacity(scene, zone, spec.seed)
    sun = _sun(spec, 1)
    lit = lit_texture(scene, sun)
    return make_stage(scene, lit, sun.direction(), sun.ambient, haze)


def _geotiff(path: Path, image: NDArray[Any], grid: GroundGrid, nodata: float | None = None) -> None:
    """A tiled GeoTIFF of (rows, columns, bands) or (rows, columns), written whole or not at all."""
    import rasterio

    bands = image[..., None] if image.ndim == 2 else image
    part = path.with_name(f".{path.name}.part")
    profile = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": bands.shape[2], "dtype": bands.dtype.name,
        "crs": f"EPSG:{grid.epsg}", "transform": grid.affine(), "tiled": True, "blockxsize": 512, "blockysize": 512,
        "compress": "deflate", "zlevel": 3, "nodata": nodata,
    }  # fmt: skip
    if bands.dtype == np.uint8:
        profile["predictor"] = 2
    if bands.shape[2] >= 3:
        profile.update(photometric="RGB", interleave="pixel")
    with rasterio.open(part, "w", **profile) as file:
        file.write(np.moveaxis(bands, 2, 0))
    os.replace(part, path)


def _write_truth(spec: TwinSpec, stage: Stage, zone: Zone | None, truth: Path) -> None:
    import cv2

    if (truth / "ground_mask.tif").exists():
        return
    s, g = stage.scene, stage.scene.grid
    size = spec.reference_gsd_m
    grid = GroundGrid(g.epsg, g.west, g.north, size, round(g.width * 0.25 / size), round(g.height * 0.25 / size))
    reference = cv2.resize(stage.levels[0], (grid.width, grid.height), interpolation=cv2.INTER_AREA)
    _geotiff(truth / "reference.tif", np.asarray(reference), grid)
    _geotiff(truth / "dsm.tif", s.dsm, s.cells)
    _geotiff(truth / "dtm.tif", s.dtm, s.cells)
    moving = (s.kind[::2, ::2] == WATER).astype(np.uint8) * 255
    _geotiff(truth / "moving_mask.tif", moving, s.cells)
    if zone is not None:
        inside = zone_mask(s, zone, spec.disaster, spec.seed)
        _geotiff(truth / "disaster_mask.tif", inside.astype(np.uint8) * 255, s.cells)
    tall = (s.above_ground() > 2.0).astype(np.uint8)
    still = cv2.dilate(tall, np.ones((5, 5), np.uint8)) == 0
    _geotiff(truth / "ground_mask.tif", (still & (moving == 0)).astype(np.uint8) * 255, s.cells)


def _write_plan(spec: TwinSpec, site: _Site, path: Path) -> None:
    across, along = (0.5 * x for x in spec.plan.extent_m)
    ring = np.array([[-across, -along], [across, -along], [across, along], [-across, along], [-across, -along]])
    features = [_feature("Polygon", [_lonlat(spec, site, ring)], {"role": "area"})]
    for v in range(spec.plan.vehicles):
        line = _lonlat(spec, site, spec.plan.corners(v))
        properties = {"role": "path", "vehicle": _vehicle_name(spec, v), "height_m": spec.plan.height_m}
        features.append(_feature("LineString", line, properties))
    _replace(path, json.dumps({"type": "FeatureCollection", "features": features}, indent=1).encode())


def _vehicle_name(spec: TwinSpec, v: int) -> str:
    return f"uav{v + 1:0{max(2, len(str(spec.plan.vehicles)))}d}"


def _lonlat(spec: TwinSpec, site: _Site, local: NDArray[np.float64]) -> list[list[float]]:
    geographic = site.grid.to_geographic(spec.plan.to_grid(local, site.center))
    return [[round(float(lon), 9), round(float(lat), 9)] for lat, lon in geographic]


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def photo_name(vehicle: str, index: int) -> str:
    """Path of a picture relative to the photos folder."""
    return f"{vehicle}/DJI_{index + 1:04d}.JPG"


def _write_frames(spec: TwinSpec, site: _Site, flights: list[Flight], path: Path) -> None:
    from datetime import UTC, datetime

    rows: list[list[Any]] = []
    for flight in flights:
        geographic = site.grid.to_geographic(flight.position[:, :2])
        convergence = site.grid.convergence_rad(geographic[:, 0], geographic[:, 1])
        degrees = np.degrees(np.c_[flight.angles[:, 0] + convergence, flight.angles[:, 1:]])
        degrees[:, 0] = (degrees[:, 0] + 180.0) % 360.0 - 180.0
        for i in range(0, len(flight.time_s), spec.every):
            moment = datetime.fromtimestamp(flight.time_s[i], UTC).isoformat(timespec="milliseconds")
            rows.append(
                [photo_name(flight.vehicle, i), flight.vehicle, moment.replace("+00:00", "Z")]
                + [f"{x:.4f}" for x in flight.position[i]]
                + [f"{x:.6f}" for x in degrees[i]]
                + [f"{np.degrees(flight.lens.fov_rad):.6f}", flight.lens.k1, flight.lens.k2, site.grid.epsg]
                + [flight.lens.width, flight.lens.height]
            )
    header = (
        "image vehicle time easting northing height yaw_deg pitch_deg roll_deg fov_deg k1 k2 epsg width height".split()
    )
    part = path.with_name(".frames.csv.part")
    with part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
    os.replace(part, path)


@dataclass(frozen=True, slots=True)
class _Shot:
    path: Path
    flight: Flight
    record: Record
    vehicle: int
    index: int


def _missing(
    spec: TwinSpec, site: _Site, flights: list[Flight], records: list[Record], folder: Path
) -> Iterator[_Shot]:
    for v, (flight, recorded) in enumerate(zip(flights, records, strict=True)):
        (folder / "photos" / flight.vehicle).mkdir(parents=True, exist_ok=True)
        for i in range(0, len(flight.time_s), spec.every):
            path = folder / "photos" / photo_name(flight.vehicle, i)
            if not path.exists():
                yield _Shot(path, flight, recorded, v, i)


def _render_all(
    spec: TwinSpec, stage: Stage, grid: LocalGrid, shots: list[_Shot], workers: int, tell: Progress
) -> Iterator[int]:
    """Render and write all shots; yields how many are done."""
    import cv2

    cv2.setNumThreads(1)
    rays = {shot.vehicle: lens_rays(shot.flight.lens) for shot in {s.vehicle: s for s in shots}.values()}
    sensor = Sensor(spec.plan.width, spec.plan.height, spec.seed)
    tell("photos", 0, len(shots))

    def one(shot: _Shot) -> None:
        _replace(shot.path, _photo(spec, stage, grid, shot, rays[shot.vehicle], sensor))

    with ThreadPoolExecutor(workers) as pool:
        for done, _ in enumerate(pool.map(one, shots), start=1):
            tell("photos", done, len(shots))
            yield done


def _photo(
    spec: TwinSpec, stage: Stage, grid: LocalGrid, shot: _Shot, rays: NDArray[np.float32], sensor: Sensor
) -> bytes:
    """One JPEG with its tags."""
    flight, i = shot.flight, shot.index
    camera = Camera(flight.position[i], rotation_from_angles(*flight.angles[i]), flight.lens)
    rng = np.random.default_rng([spec.seed, 83, shot.vehicle, i])
    wind = np.array([0.0, 0.0, 0.0, 0.0, 1.1, 0.4, 0.5, -0.3]) * flight.time_s[i]
    jump = np.array([1e3, 1e3, 1e3, 1e3, 25.0, 25.0, 8.0, 8.0])
    motion = (wind + rng.uniform(0, 1, 8) * jump) % 1024.0
    image = sensor.expose(render(stage, camera, rays, motion), rng)
    position, angles, body = shot.record.position[i], shot.record.angles[i], shot.record.body[i]
    lat, lon = (float(x) for x in grid.to_geographic(position[:2]))
    convergence = float(grid.convergence_rad(lat, lon))
    tags = PhotoTags(
        float(flight.time_s[i]), lat, lon, float(position[2]) + SEA_LEVEL_M, float(position[2]),
        _degrees(angles, convergence), _degrees(body, convergence),
    )  # fmt: skip
    return with_tags(sensor.encode(image, spec.quality), tags)


def _degrees(angles: NDArray[np.float64], convergence: float) -> tuple[float, float, float]:
    yaw, pitch, roll = (float(x) for x in np.degrees(angles))
    return yaw + float(np.degrees(convergence)), pitch, roll


def with_heading(spec: TwinSpec) -> TwinSpec:
    """A spec whose flight direction is drawn from its seed (the presets fly north)."""
    rng = np.random.default_rng([spec.seed, 97])
    quarter = float(rng.choice([0.0, np.pi / 2]))
    if spec.ground is not None:  # the long side of the area along the long side of the place
        from orthoswarm.twin.photo_ground import ground_place

        size = ground_place(spec.ground)[2]
        across, along = spec.plan.extent_m
        quarter = 0.0 if (across >= along) == (size[0] >= size[1]) else np.pi / 2
    heading = quarter + np.radians(rng.uniform(-12.0, 12.0))
    return replace(spec, plan=replace(spec.plan, heading_rad=float(heading)))


__all__ = ["CELL_M", "TwinSet", "make_twin", "map_lean", "photo_name", "suns", "with_heading"]

"""Make a data set: the map before the disaster, the photos after it, and the truth in its own folder."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.camera import Camera, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.task_runner import Progress
from orthoswarm.twin.dataset_files import (
    after_disaster,
    photo_name,
    write_atomic,
    write_basemap,
    write_frames,
    write_plan,
    write_truth,
)
from orthoswarm.twin.drone_photo import PhotoTags, Sensor, with_tags
from orthoswarm.twin.flights import Record, TrueFlight, fly, raised, record
from orthoswarm.twin.presets import TwinSpec
from orthoswarm.twin.ray_marching import PreparedScene, lens_rays, render
from orthoswarm.twin.site import Site, disaster_zones

SEA_LEVEL_M = 512.0
"""Absolute altitude of the takeoff point; far from 0, so that mixing up altitude and height shows at once."""
GENERATOR = 3
"""Version of the generator; raised when the same parameters give other photos or another truth.

A half-made set is continued only by the version that began it.
"""


@dataclass(frozen=True, slots=True)
class TwinSet:
    """Summary of a data set after `make_twin`."""

    folder: Path  # of the set
    photos: int  # pictures of the set
    made: int  # those rendered in this run (the others existed)
    vehicles: int  # number of vehicles


@dataclass(frozen=True, slots=True)
class TwinScene:
    """What photos are taken of and from: the scene after the disaster, its site, true flights and recorded ones."""

    stage: PreparedScene
    site: Site
    flights: list[TrueFlight]
    records: list[Record]


def make_twin(
    spec: TwinSpec, folder: Path, *, workers: int = 1, progress: Progress | None = None, only: int | None = None
) -> TwinSet:
    """Make a data set; existing pictures are not rendered again, so an interrupted run can be continued.

    Layout: photos/<vehicle>/<name>.JPG, basemap.tif, plan.geojson; truth/ holds frames.csv, reference.tif, dsm.tif,
    dtm.tif, masks and manifest.json. The same spec gives the same bytes.

    Args:
        spec: what to make. folder: where to put it. workers: threads that render.
        progress: called with a stage's name, the number of finished items and their total.
        only: stop after this many new pictures (None: all).

    Raises:
        InputError: if the folder holds another set.
    """
    import cv2

    report = progress or (lambda *_: None)
    made = make_scene(spec, folder, report)
    shots = []  # of the pictures that do not exist yet: path, vehicle and index
    for v, flight in enumerate(made.flights):
        (folder / "photos" / flight.vehicle).mkdir(parents=True, exist_ok=True)
        for i in range(0, len(flight.time_s), spec.every):
            path = folder / "photos" / photo_name(flight.vehicle, i)
            if not path.exists():
                shots.append((path, v, i))
    shots = shots[:only]
    cv2.setNumThreads(1)
    rays = {v: lens_rays(made.flights[v].lens, spec.rays) for v in {v for _, v, _ in shots}}
    sensor = Sensor(spec.plan.width, spec.plan.height, spec.seed)
    report("photos", 0, len(shots))

    def one(shot: tuple[Path, int, int]) -> None:
        path, v, i = shot
        write_atomic(path, _photo(spec, made, v, i, rays=rays[v], sensor=sensor))

    with ThreadPoolExecutor(workers) as pool:
        for done, _ in enumerate(pool.map(one, shots), start=1):
            report("photos", done, len(shots))
    total = spec.plan.vehicles * len(range(0, spec.plan.photos, spec.every))
    return TwinSet(folder, total, len(shots), spec.plan.vehicles)


def make_scene(spec: TwinSpec, folder: Path, report: Progress) -> TwinScene:
    """Make all of a data set but its photos; arguments and errors as of `make_twin`."""
    truth = folder / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    _claim(truth / "manifest.json", spec)
    report("city", 0, 1)
    site = Site.of(spec)
    flights = [
        fly(spec.plan, spec.motion, site.center, vehicle=v, seed=spec.seed, lens_k=spec.lens_k)
        for v in range(spec.plan.vehicles)
    ]
    scene, slots = site.build(spec)
    if spec.follow_ground:
        flights = [raised(flight, scene.bare_ground()) for flight in flights]
    records = [record(flight, spec.noise, v, spec.seed) for v, flight in enumerate(flights)]
    zones = disaster_zones(spec, site)
    if not (folder / "basemap.tif").exists():
        report("basemap", 0, 1)
        write_basemap(spec, scene, slots, folder / "basemap.tif", truth)
    report("disaster", 0, 1)
    stage = after_disaster(spec, scene, slots, zones)
    write_truth(spec, stage, zones, truth)
    write_plan(spec, site, folder / "plan.geojson")
    write_frames(spec, site, flights, truth / "frames.csv")
    return TwinScene(stage, site, flights, records)


def _claim(manifest: Path, spec: TwinSpec) -> None:
    text = json.dumps({"generator": GENERATOR, **asdict(spec)}, indent=1, sort_keys=True)
    if manifest.exists():
        if json.loads(manifest.read_text()) != json.loads(text):
            raise InputError(f"{manifest.parent.parent} holds a set with other parameters; choose another folder")
        return
    write_atomic(manifest, text.encode())


def _photo(spec: TwinSpec, made: TwinScene, vehicle: int, i: int, *, rays: Floats, sensor: Sensor) -> bytes:
    """The JPEG of a vehicle's i-th picture with its tags."""
    flight, recorded = made.flights[vehicle], made.records[vehicle]
    camera = Camera(flight.position[i], rotation_from_angles(*flight.angles[i]), flight.lens)
    rng = np.random.default_rng([spec.seed, 83, vehicle, i])
    wind = np.array([0.0, 0.0, 0.0, 0.0, 1.1, 0.4, 0.5, -0.3]) * flight.time_s[i]
    jump = np.array([1e3, 1e3, 1e3, 1e3, 25.0, 25.0, 8.0, 8.0])
    motion = (wind + rng.uniform(0, 1, 8) * jump) % 1024.0
    image = sensor.expose(render(made.stage, camera, rays, motion), rng)
    position, angles, body = recorded.position[i], recorded.angles[i], recorded.body[i]
    lat, lon = (float(x) for x in made.site.grid.to_geographic(position[:2]))
    convergence = float(made.site.grid.convergence_rad(lat, lon))
    tags = PhotoTags(
        time_s=float(flight.time_s[i]), lat_deg=lat, lon_deg=lon, altitude_m=float(position[2]) + SEA_LEVEL_M,
        height_m=float(position[2]), gimbal_deg=_degrees(angles, convergence), flight_deg=_degrees(body, convergence),
    )  # fmt: skip
    return with_tags(sensor.encode(image, spec.quality), tags)


def _degrees(angles: Array, convergence: float) -> tuple[float, float, float]:
    yaw, pitch, roll = (float(x) for x in np.degrees(angles))
    return yaw + float(np.degrees(convergence)), pitch, roll

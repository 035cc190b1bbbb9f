"""The paper's refiner: III.C for each vehicle, III.D for each leg, then cameras for all frames.

Legs are independent tasks (III.E). By Eq. 5 a run takes as long as its slowest task plus the sequential rest, given
enough workers; `Refinement.equation_5` compares this with the time measured.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter, process_time
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Camera
from orthoswarm.model.frame import Frame
from orthoswarm.model.placement import Leg, LegState, MapWindow, PlacedFrame, Refinement, Solution, Stage
from orthoswarm.model.task_runner import Progress, Run, serial
from orthoswarm.paper.coarse_cameras import RECEIVER_SIGMA_M, CoarseVehicle, PaperOptions, coarse_vehicle
from orthoswarm.paper.leg_patches import PatchFit, PatchTask, match_patch
from orthoswarm.refine.flight.vehicle_refinement import UnitRefiner, merge_units, unit_states, units_of_area

_CARRYING_NEIGHBOURS: Final = 3  # nearest registered legs of neighbours that carry a vehicle without one
_CARRIED_SIGMA_M: Final = 2.0  # least sigma of a correction carried from other legs


@dataclass(frozen=True, slots=True)
class PaperState:
    """What a solved unit passes on to later calls."""

    found: list[tuple[Array, Array]]  # centre and shift of each leg that was found on the map, for neighbours
    frames: list[Frame]  # those that were placed


@dataclass(frozen=True, slots=True)
class PaperRefiner(UnitRefiner):
    """The paper's refiner behind the interface `placement.Refiner`."""

    options: PaperOptions = field(default_factory=PaperOptions)  # see PaperOptions

    def solve(self, units: list[list[Frame]], neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """All steps for one vehicle; if none of its legs is found on the map, it gets its neighbours' correction."""
        from_neighbours = [pair for n in neighbours for pair in _found(n)]
        return self._refined(units, from_neighbours, basemap).fine[0]

    def again(self, solution: Solution, neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """Place a vehicle again with later neighbours; changes only a vehicle with no leg of its own on the map."""
        if _found(solution) or not any(_found(n) for n in neighbours):
            return solution
        now = self.refine([p.frame for p in solution.placed], neighbours, basemap)
        return replace(now, dropped={**solution.dropped, **now.dropped})

    def refined_frames(self, solution: Solution) -> list[Frame]:
        """The frames of the vehicle's units (placement.Refiner)."""
        return [frame for state in unit_states(solution) for frame in state.frames]

    def refine_batch(
        self,
        vehicles: Mapping[str, Sequence[Frame]],
        basemap: MapWindow | None,
        run: Run = serial,
        progress: Progress | None = None,
        *,
        halo: Collection[str] = (),
    ) -> Refinement:
        """Place all vehicles of an area (placement.Refiner), those of the halo as all; the paper's ground is flat."""
        return self._refined(units_of_area(vehicles), [], basemap, run, progress)

    def _refined(
        self, units: Sequence[Sequence[Frame]], from_neighbours: Sequence[tuple[Array, Array]],
        basemap: MapWindow | None, run: Run = serial, progress: Progress | None = None,
    ) -> Refinement:  # fmt: skip
        clock = perf_counter()
        first = partial(_timed_coarse, epsg=self.epsg, origin=self.origin, options=self.options)
        coarse: list[CoarseVehicle] = []
        tasks_s: dict[str, list[float]] = {"vehicles (III.C)": [], "legs (III.D)": []}
        parallel_s = -perf_counter()
        for n, (vehicle, seconds) in enumerate(run(first, units)):
            coarse.append(vehicle)
            tasks_s["vehicles (III.C)"].append(seconds)
            if progress:
                progress("lines and fields of view", n + 1, len(units))
        parallel_s += perf_counter()
        fits: list[dict[int, PatchFit]] = [{} for _ in coarse]
        if basemap is not None:
            tasks = []
            for u, vehicle in enumerate(coarse):
                for k in range(len(vehicle.lines)):
                    if len(members := vehicle.members(k)):
                        frames = [vehicle.frames[i] for i in members]
                        tasks.append((u, PatchTask(k, frames, vehicle.cameras.take(members))))
            second = partial(match_patch, basemap=basemap, origin=self.origin, options=self.options)
            parallel_s -= perf_counter()
            for n, fit in enumerate(run(second, [t for _, t in tasks])):
                fits[tasks[n][0]][fit.leg] = fit
                tasks_s["legs (III.D)"].append(fit.wall_s)
                if progress:
                    progress("legs on the map", n + 1, len(tasks))
            parallel_s += perf_counter()
        found = (fit for own in fits for fit in own.values() if fit.homography is not None)
        everyone = [*from_neighbours, *((fit.centre, fit.shift) for fit in found)]
        stage: Stage = "fine" if basemap is not None else "coarse"
        before = [_solution(v, {}, [], self.origin, "coarse") for v in coarse]
        after = [_solution(v, own, everyone, self.origin, stage) for v, own in zip(coarse, fits, strict=True)]
        fine = merge_units(after)
        wall_s = perf_counter() - clock
        return Refinement(merge_units(before), fine, None, [], _equation_5(tasks_s, wall_s - parallel_s, wall_s))


def _found(solution: Solution) -> list[tuple[Array, Array]]:
    return [pair for state in unit_states(solution) for pair in state.found]


def _equation_5(tasks_s: Mapping[str, Sequence[float]], sequential_s: float, wall_s: float) -> dict[str, float]:
    """Eq. 5 and the measured time: slowest task of each parallel step plus the sequential rest, and the wall time.

    The two agree when there are as many free cores as tasks; the difference is what more workers could save.

    Args:
        tasks_s: wall seconds of each parallel task, by step.
        sequential_s: wall seconds between and after these steps. wall_s: of the complete run.
    """
    slowest = sum(max(t, default=0.0) for t in tasks_s.values())
    return {
        "slowest_tasks_s": slowest,
        "sequential_s": sequential_s,
        "predicted_s": slowest + sequential_s,
        "measured_s": wall_s,
    }


def _timed_coarse(
    frames: Sequence[Frame], *, epsg: int, origin: Array, options: PaperOptions
) -> tuple[CoarseVehicle, float]:
    clock = perf_counter()
    return coarse_vehicle(frames, epsg=epsg, origin=origin, options=options), perf_counter() - clock


def _solution(
    vehicle: CoarseVehicle, fits: Mapping[int, PatchFit], everyone: Sequence[tuple[Array, Array]], origin: Array,
    stage: Stage,
) -> Solution:  # fmt: skip
    """Cameras of all frames: by the homography of their leg, or by interpolated corrections where it was not found."""
    began = process_time()
    dropped = {vehicle.frames[i].image: why for i, why in vehicle.damaged.items()}
    for fit in fits.values():
        dropped |= fit.damaged
    matched = {k: f for k, f in fits.items() if f.homography is not None}
    shift, carried_sigma = _carried(vehicle, matched, everyone)
    on_map = bool(matched) or shift is not None
    placed = []
    sigmas = vehicle.sigma_m.copy()
    for i, frame in enumerate(vehicle.frames):
        if frame.image in dropped:
            continue
        camera = vehicle.cameras.camera(i, np.zeros(2))
        found = matched.get(int(vehicle.leg[i]))
        if found is not None:
            pixels = pixel_grid(camera)
            ground = camera.to_ground(pixels)
            if np.isfinite(ground).all():
                camera, rms_m = fit_camera(camera, found.move(ground), pixels)
                line = vehicle.lines[int(vehicle.leg[i])].sigma_m  # along the line the records are as rough as across
                sigmas[i] = np.sqrt(found.rms_m**2 + line**2 / 2 + rms_m**2)
        elif shift is not None:
            camera = replace(camera, position=camera.position + np.array([*shift[i], 0.0]))
            sigmas[i] = np.hypot(
                carried_sigma, sigmas[i] if vehicle.leg[i] < 0 else vehicle.lines[vehicle.leg[i]].sigma_m
            )
        camera = replace(camera, position=camera.position + np.array([*origin, 0.0]))
        placed.append(PlacedFrame(frame, camera, stage if on_map or stage == "coarse" else "coarse", float(sigmas[i])))
    warnings = list(vehicle.warnings)
    if stage == "fine" and not matched:
        how = "neighbours carry it" if shift is not None else "it lies in the GPS frame"
        warnings.append(f"no leg of this flight was found on the map; {how}")
    state = PaperState([(f.centre, f.shift) for f in matched.values()], [p.frame for p in placed])
    timings = {"relative": vehicle.cpu_s, "patches": sum(f.cpu_s for f in fits.values())}
    timings["cameras"] = process_time() - began
    return Solution(
        vehicle=vehicle.vehicle, placed=placed, dropped=dropped, legs=_legs(vehicle, fits, sigmas, shift is not None),
        fov_deg=float(np.degrees(vehicle.cameras.camera(0, origin).lens.fov_rad)),
        fov_sigma_deg=float(np.degrees(vehicle.fov_sigma_rad)), terrain=None, ground_z_m=0.0, map_lean=(0.0, 0.0),
        state=state, warnings=warnings, timings=timings,
    )  # fmt: skip


def _carried(
    vehicle: CoarseVehicle, matched: Mapping[int, PatchFit], everyone: Sequence[tuple[Array, Array]]
) -> tuple[Array | None, float]:
    """Corrections (N, 2) for frames of legs that were not found, from the vehicle's other legs, else from neighbours.

    The second value is one sigma of such a correction, metres.
    """
    number = np.arange(len(vehicle.frames), dtype=float)
    if matched:
        own = [(float(np.flatnonzero(vehicle.leg == k).mean()), f.shift) for k, f in matched.items()]
        shifts = np.array([s for _, s in own])
        return carried_shift(number, own), float(max(np.hypot(*shifts.std(axis=0)), _CARRIED_SIGMA_M))
    if everyone:
        centre = np.array([c for c, _ in everyone])
        shifts = np.array([s for _, s in everyone])
        away = np.hypot(*(centre - vehicle.cameras.position[:, :2].mean(axis=0)).T)
        nearest = np.argsort(away)[:_CARRYING_NEIGHBOURS]
        usual = np.median(shifts[nearest], axis=0)
        return np.tile(usual, (len(number), 1)), RECEIVER_SIGMA_M
    return None, RECEIVER_SIGMA_M


def _legs(vehicle: CoarseVehicle, fits: Mapping[int, PatchFit], sigma: Array, carried: bool) -> list[Leg]:
    out = []
    for k in range(len(vehicle.lines)):
        members = np.flatnonzero(vehicle.leg == k)
        fit = fits.get(k)
        found = fit is not None and fit.homography is not None
        how: LegState = "matched" if found else "carried" if carried else "failed"
        confidence = fit.share if fit is not None and found else 0.0
        out.append(Leg.of(vehicle.frames, members, how, confidence, float(np.median(sigma[members]))))
    return out


# -- from the homography of a leg to cameras ---------------------------------------------------------------------------

_POSE_ROUNDS: Final = 6  # most Gauss-Newton steps of the pose that reproduces a homography best


def fit_camera(camera: Camera, corrected: Array, pixels: Array) -> tuple[Camera, float]:
    """Space resection by Gauss-Newton: the pose that images ground points (N, 2) at height 0 at pixels (N, 2).

    Returns the camera and the rms of the residuals of its ground points, metres.
    """
    points = np.c_[corrected, np.zeros(len(corrected))]
    position = camera.position + np.array([*(corrected - camera.to_ground(pixels)).mean(axis=0), 0.0])
    current = Camera(position, camera.rotation, camera.lens)
    for _ in range(_POSE_ROUNDS):
        projected = current.project(points)
        jacobian = np.empty((2 * len(points), 6))
        for k in range(6):
            change = np.zeros(6)
            change[k] = 1e-5
            jacobian[:, k] = ((_apply_step(current, change).project(points) - projected) / 1e-5).ravel()
        step, *_ = np.linalg.lstsq(jacobian, (pixels - projected).ravel(), rcond=None)
        if not np.isfinite(step).all():
            break
        current = _apply_step(current, np.asarray(step, np.float64))
        if np.abs(step).max() < 1e-7:
            break
    error = current.to_ground(pixels) - corrected
    return current, float(np.sqrt((error**2).sum(1).mean()))


def pixel_grid(camera: Camera, columns: int = 6, rows: int = 5) -> Array:
    """Pixels (N, 2) evenly over a picture."""
    u = np.linspace(0.05, 0.95, columns) * (camera.lens.width - 1)
    v = np.linspace(0.05, 0.95, rows) * (camera.lens.height - 1)
    return np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)


def carried_shift(index: Array, matched: Sequence[tuple[float, Array]]) -> Array:
    """Corrections (N, 2) of frames between matched legs of the same vehicle, interpolated by frame number.

    index: float64 (N,), frame numbers. matched: middle frame number and shift (2,) of each leg that was found.
    """
    order = sorted(matched, key=lambda m: m[0])
    at = np.array([m[0] for m in order])
    shift = np.array([m[1] for m in order])
    return np.column_stack([np.interp(index, at, shift[:, k]) for k in range(2)])


def _apply_step(camera: Camera, step: Array) -> Camera:
    return Camera(camera.position + step[:3], rotation_of(step[3:]) @ camera.rotation, camera.lens)


def rotation_of(vector: Array) -> Array:
    """The rotation (3, 3) about a vector by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-15:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k))
